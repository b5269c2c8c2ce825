"""A piece of the user's from its name to what drives or plans in a simulator."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from uuvtai.env import NUM_ACTIONS
from uuvtai.kernels.planning.features import placed_columns
from uuvtai.own import answers, onnx_policy
from uuvtai.own.call_meter import CallMeter
from uuvtai.own.own_driver import Marks, OwnCode, OwnDriver, asking_controller, asking_policy
from uuvtai.own.piece_errors import PieceError
from uuvtai.own.piece_loading import (
    FACTORY,
    MAX_BYTES,
    content_of,
    inner_of,
    made,
    method_of,
    object_of,
    place_of,
)
from uuvtai.own.piece_spec import CONTROLLER, PLANNER, POLICY, PieceSpec
from uuvtai.own.protocol import About, Forecast, piece
from uuvtai.rrt import PlanRequest
from uuvtai.sim import Sim

_USAGE = {
    PLANNER: "a planner is called plan(clearance, cell_m, start, goal, forecast)",
    CONTROLLER: "a controller is called act(view)",
    POLICY: "a policy is called act(obs)",
}
_METHODS = {PLANNER: ("plan",), CONTROLLER: ("act",), POLICY: ("act", "predict")}
_ARGUMENTS = {PLANNER: 5, CONTROLLER: 1, POLICY: 1}
_LIMITS = ("max_surge_m_s", "max_sway_m_s", "max_heave_m_s", "max_yaw_rate_rad_s")


def _say(text: str) -> None:
    print(text, file=sys.stderr)


@dataclass
class OwnPiece:
    """A piece that was found: its file can be read and has what it names."""

    spec: PieceSpec
    sha256: str
    """of its file; what that imports is not in it"""
    found: Any
    """the object; an ONNX graph's bytes"""
    note: Callable[[str], None] = _say
    """told of calls that take too long"""
    meter: CallMeter | None = field(default=None, init=False)

    @property
    def label(self) -> str:
        """What it is called in tables."""
        return self.spec.label

    def driver(self, sim: Sim) -> OwnDriver | None:
        """Who drives this simulator; None for a planner, where the tree does. Raises PieceError."""
        if self.spec.kind == PLANNER:
            return None
        columns = columns_of(sim)
        about = about_of(sim, self.spec.argument)
        code = self._code(sim, about)
        if self.spec.kind == CONTROLLER:
            return OwnDriver(sim, code, asking_controller(sim, code, columns, about.limits))
        return OwnDriver(sim, code, asking_policy(code, sim.device))

    def planner(self, sim: Sim) -> RouteSource | None:
        """Who plans routes in this simulator; None where its own planner does. Raises PieceError."""
        if self.spec.kind != PLANNER:
            return None
        code = self._code(sim, about_of(sim, self.spec.argument))
        return RouteSource(code, sim.config.mapping.cell_m, sim.config.tracking.forecast_dt_s)

    def told(self) -> str:
        """What has to be said of its time; empty = nothing."""
        return self.meter.told() if self.meter else ""

    def close(self) -> None:
        """Nobody waits for a call any more."""
        if self.meter:
            self.meter.close()

    def document(self) -> dict[str, Any]:
        """What ``uuv eval --json`` says of it: where it comes from, and the time of its calls so far."""
        spec = self.spec
        where = {
            "kind": spec.kind,
            "file": str(spec.path),
            "object": spec.name or None,
            "sha256": self.sha256,
        }
        return where | (self.meter.document() if self.meter else {})

    def _code(self, sim: Sim, about: About) -> OwnCode:
        spec, kind = self.spec, self.spec.kind
        # a route is planned while the vehicle drives on: its time is held against a control step all the same
        self.meter = CallMeter(spec.option, spec.path, about.dt_s, self.note)
        if not spec.is_code:
            act, hold_steps = onnx_policy.onnx_policy(spec, self.found, about.n_obs)
            return OwnCode(spec, act, None, str(spec.path), Marks(hold_steps=hold_steps), self.meter)
        drives = made(self.found, spec, about)
        inner = inner_of(drives)
        act = method_of(drives, _METHODS[kind], spec, _USAGE[kind], _ARGUMENTS[kind])
        place = f"{place_of(act, spec)}: {spec.name if act is inner else getattr(act, '__name__', spec.name)}"
        marks = _marks(drives, place)
        if kind == POLICY and getattr(act, "__name__", "") == "predict":
            act = _predicting(act)
        return OwnCode(spec, act, _reset_of(inner, self.found), place, marks, self.meter)


def own_piece(spec: PieceSpec) -> OwnPiece:
    """The piece of a name, refused at once where its file or object is missing. Raises PieceError,
    FileError."""
    if not spec.is_code:
        graph = onnx_policy.graph_of(spec)
        return OwnPiece(spec, hashlib.sha256(graph).hexdigest(), graph)
    content = content_of(spec, MAX_BYTES)
    return OwnPiece(spec, hashlib.sha256(content).hexdigest(), object_of(spec))


def columns_of(sim: Sim) -> dict[str, slice]:
    """Columns of the observation by name."""
    return {c.name: slice(first, first + width) for c, first, width in placed_columns(sim.config.features)}


def about_of(sim: Sim, argument: str = "") -> About:
    """What a piece is told before it begins."""
    config, columns = sim.config, columns_of(sim)
    limits = np.array([getattr(config.vehicle, name) for name in _LIMITS], np.float32)
    assert len(limits) == NUM_ACTIONS
    return About(
        num_envs=sim.num_envs, dt_s=config.episode.control_dt_s, limits=limits, columns=columns,
        n_obs=max(place.stop for place in columns.values()), cell_m=config.mapping.cell_m,
        min_clearance_m=config.voronoi.min_clearance_m, device=sim.device.type, argument=argument,
    )  # fmt: skip


def _marks(drives: Any, place: str) -> Marks:
    """How it wants to be called; torch for a torch module that says nothing."""
    arrays = "torch" if isinstance(inner_of(drives), torch.nn.Module) else "numpy"
    found = Marks(
        *(getattr(drives, name, default) for name, default in Marks(arrays=arrays)._asdict().items())
    )
    given: Any = found
    try:
        piece(*given)
    except ValueError as error:
        raise PieceError(f"{place}: {error}") from None
    return found


def _predicting(predict: Callable[..., Any]) -> Callable[[Any], Any]:
    """Stable-Baselines3's way: (actions, state), without exploration where it can be asked for."""
    plain = "deterministic" not in inspect.signature(predict).parameters

    def act(obs: Any) -> Any:
        found = predict(obs) if plain else predict(obs, deterministic=True)
        return found[0] if isinstance(found, tuple) else found

    return act


def _reset_of(inner: Any, found: Any) -> Callable[..., Any] | None:
    """Its own method; of a plain function the function ``reset`` beside it in the file."""
    own = getattr(inner, "reset", None)
    if inspect.isroutine(inner) and getattr(inner, "__name__", "") != FACTORY:
        own = getattr(sys.modules.get(inner.__module__), "reset", None) if inner is found else None
    return own if callable(own) else None


class RouteSource:
    """Calls ``plan(clearance, cell_m, start, goal, forecast)`` for one env after the other; ``row=`` too
    where it has that parameter."""

    def __init__(self, code: OwnCode, cell_m: float, forecast_dt_s: float) -> None:
        self.code, self._cell_m, self._dt_s = code, cell_m, forecast_dt_s
        self._wants_row = "row" in inspect.signature(code.act).parameters

    def reset(self, mask: torch.Tensor) -> None:
        """New episodes begin in the rows (n_env,) where this is not 0."""
        self.code.forget(mask)

    def plan(self, asked: PlanRequest) -> np.ndarray | None:
        """Corners (n >= 2, 2) [m] from start to goal; None = no way. PieceError for any other answer."""
        forecast = Forecast(asked.body, asked.radius_m, self._dt_s)
        more = {"row": asked.env} if self._wants_row else {}

        def called(_given: None) -> object:
            return self.code.act(
                asked.clearance_m, self._cell_m, asked.start.copy(), asked.goal.copy(), forecast, **more
            )

        found = self.code.called(called, None, 1)
        if found is None:
            return None
        n_row, n_col = asked.clearance_m.shape
        size_m = n_col * self._cell_m, n_row * self._cell_m
        return answers.waypoints(found, (asked.start, asked.goal), size_m, self.code.place)
