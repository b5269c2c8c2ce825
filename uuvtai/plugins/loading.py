"""The one place where Python of the user's is imported: from the file that she named, never from one that a
file names."""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np
import torch
from pydantic import ValidationError

from uuvtai.common.files import read_bytes, refusing
from uuvtai.config import FixedObstacle
from uuvtai.config.loader import nearest
from uuvtai.envs.vector_env import NUM_ACTIONS, VectorEnv
from uuvtai.kernels.planning.observation import placed_columns
from uuvtai.learning.export import graph as graph_check
from uuvtai.learning.policy_agent import CHUNK
from uuvtai.plugins import adapters, api
from uuvtai.sim.rrt import PlanRequest
from uuvtai.sim.sim import Sim

MAX_BYTES = 1 << 20
"""of a Python file"""
FACTORY = "load"
"""a function of this name is called once; what it returns drives"""

_loaded: dict[tuple[str, str], ModuleType] = {}
_importing: set[tuple[str, str]] = set()


class _OwnSource(SourceFileLoader):
    """Reads as everything is read, and leaves no bytecode beside the user's file."""

    def get_data(self, path: str) -> bytes:
        return read_bytes(Path(path), MAX_BYTES)

    def path_stats(self, path: str) -> Any:
        raise OSError

    def set_data(self, *_given: Any, **_others: Any) -> None:
        pass


def content_of(spec: api.PluginSpec, limit: int) -> bytes:
    """The plugin's file. Raises PluginError where there is none, FileError for what is no plain file."""
    with refusing(api.PluginError, f"{spec.option}: {spec.path} cannot be read"):
        return read_bytes(spec.path, limit)


def object_of(spec: api.PluginSpec) -> Any:
    """The object that the plugin names, its file imported once per content. Raises PluginError, FileError."""
    module = _module(spec)
    if not hasattr(module, spec.name):
        there = [
            name
            for name, value in vars(module).items()
            if callable(value) and getattr(value, "__module__", "") == module.__name__
        ]
        raise api.PluginError(
            f"{spec.option}: {spec.path} has no {spec.name!r}; it has {', '.join(there) or 'no function'}"
        )
    return getattr(module, spec.name)


def _module(spec: api.PluginSpec) -> ModuleType:
    digest = hashlib.sha256(content_of(spec, MAX_BYTES)).hexdigest()
    key = str(spec.path.resolve()), digest
    if key not in _loaded:
        name = f"uuv_own_{spec.path.stem}_{digest[:8]}"
        if key in _importing:
            below = "move all but imports, functions and classes below 'if __name__ == \"__main__\":'"
            raise api.PluginError(f"{spec.path}: runs itself again; {below}")
        found = importlib.util.spec_from_loader(name, _OwnSource(name, str(spec.path)))
        assert found is not None  # a loader was given
        module = importlib.util.module_from_spec(found)
        folder = str(spec.path.resolve().parent)
        if folder not in sys.path:  # what lies beside it can be imported, as for 'python mine.py'
            sys.path.insert(0, folder)
        sys.modules[name] = module  # dataclasses and pickles look for it
        _importing.add(key)
        try:
            _OwnSource(name, str(spec.path)).exec_module(module)
        except (Exception, SystemExit) as error:
            del sys.modules[name]
            raise api.failed(error, spec.path, f"while {spec.option} was imported") from error
        finally:
            _importing.discard(key)
        _loaded[key] = module
    return _loaded[key]


def made(found: Any, spec: api.PluginSpec, about: api.About) -> Any:
    """What drives: the object itself, an instance of a class, or what a function named ``load`` returns.
    Raises PluginError."""
    is_class, make = inspect.isclass(found), cast("Callable[..., Any]", found)
    if not is_class and not (spec.name == FACTORY and inspect.isroutine(found)):
        return found
    takes, may_take = _parameters(found)
    if takes > 1:
        raise api.PluginError(
            f"{place_of(found, spec)}: {spec.name} needs {takes} arguments; it gets one (about) or none"
        )
    try:
        made_one = make(about) if takes or may_take else make()
    except (Exception, SystemExit) as error:
        raise api.failed(error, spec.path, f"while {spec.option} was made") from error
    for name in ("rows", "arrays", "hold_steps"):  # a decorated ``load`` says it for what it returns
        if not is_class and hasattr(found, name) and not hasattr(made_one, name):
            return _Marked(made_one, {n: getattr(found, n) for n in ("rows", "arrays", "hold_steps")})
    return made_one


class _Marked:
    """An object of somebody else's library with the marks of ``plugin``."""

    def __init__(self, inner: Any, marks: dict[str, Any]) -> None:
        self.inner = inner
        vars(self).update(marks)


def inner_of(found: Any) -> Any:
    """The object below the marks."""
    return found.inner if isinstance(found, _Marked) else found


def _parameters(found: Any) -> tuple[int, bool]:
    """(arguments that it needs at least, whether the first is ``about``, though it may be left out)."""
    try:
        given = inspect.signature(found).parameters
    except (TypeError, ValueError):  # of compiled code
        return 0, False
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    needed = sum(p.default is p.empty and p.kind in kinds for p in given.values())
    return needed, next(iter(given), "") == "about"


def agent_of(found: Any, spec: api.PluginSpec) -> Callable[..., Any]:
    """The function to call: the first method of its kind that the object has, or the object itself. Raises
    PluginError where there is none, or where it takes another number of arguments."""
    inner, (names, count, usage) = inner_of(found), _CALLS[spec.kind]
    method = next((getattr(inner, name) for name in names if callable(getattr(inner, name, None))), inner)
    if not callable(method):
        raise api.PluginError(
            f"{spec.option}: {spec.name} is {type(inner).__name__}, which cannot be called and has no "
            f"{' or '.join(names)}; {usage}"
        )
    try:
        taken = inspect.signature(method)
        taken.bind(*range(count), **({"row": 0} if "row" in taken.parameters else {}))
    except TypeError as error:
        raise api.PluginError(f"{place_of(method, spec)}: {error}; {usage}") from None
    except ValueError:  # of compiled code
        pass
    return method


def place_of(found: Any, spec: api.PluginSpec) -> str:
    """FILE:LINE where a function or a class begins, as far as it is known."""
    code = getattr(inspect.unwrap(found) if inspect.isroutine(found) else found, "__code__", None)
    if code is not None and code.co_filename == str(spec.path):
        return f"{spec.path}:{code.co_firstlineno}"
    return str(spec.path)


# ---- A policy as an ONNX graph of whoever's: it holds our operators alone, and its size, memory and work are
# reckoned before ONNX Runtime sees it (``learning.export.graph``).

HOLD = "hold_steps"
"""key of the graph's metadata: control steps that a decision is held for"""
_OUTPUTS = ("action", "actions", "mean_action", "mean_actions", "mean")
"""names that an action has where a graph gives more than it"""
MAX_GRAPH_BYTES = graph_check.MAX_BYTES


def graph_of(spec: api.PluginSpec) -> bytes:
    """The file, with its weights if they lie beside it, no larger than a graph may be. Raises PluginError,
    FileError."""
    if not graph_check.is_installed():
        raise api.PluginError(f"{spec.option}: needs onnx and onnxruntime: pip install 'uuvtai[export]'")
    graph = content_of(spec, MAX_GRAPH_BYTES)

    def beside(name: str) -> bytes:
        told = f"{spec.path}: its weights are in {name}, which cannot be read"
        with refusing(api.PluginError, told, "copy that file too, beside it"):
            return read_bytes(spec.path.parent / name, MAX_GRAPH_BYTES, spec.path.parent)

    try:
        return graph_check.with_weights(graph, beside)
    except graph_check.GraphError as error:
        raise api.PluginError(f"{spec.path}: {error.reason}") from None


def onnx_policy(
    spec: api.PluginSpec, graph: bytes, n_obs: int
) -> tuple[Callable[[np.ndarray], np.ndarray], int]:
    """(function from observations (n, n_obs) to actions (n, 4), control steps per decision). Raises
    PluginError for a graph that is strange, or made for another observation."""
    try:
        head = graph_check.head_of(graph)
        output = next((known for known in _OUTPUTS if known in head.outputs), head.outputs[0])
        if len(head.outputs) > 1:
            graph = graph_check.only(graph, output)
        if len(head.inputs) != 1:
            raise api.PluginError(
                f"{spec.path}: takes {', '.join(head.inputs) or 'nothing'}; a policy takes one input, "
                f"observations (n, {n_obs}), and keeps no state; of 'uuv export' evaluate its run"
            )
        name, (width, rows, dtype) = next(iter(head.inputs.items()))
        if dtype is None or rows == 0 or (rows or 0) > CHUNK:
            raise api.PluginError(
                f"{spec.path}: {name} takes no observations: a float input (n, {n_obs}) does, n "
                f"open, 1, or up to {CHUNK}"
            )
        if width not in (None, n_obs):
            raise api.PluginError(
                f"{spec.path}: takes observations of {width} columns, here they have {n_obs} "
                "(docs/extend.md lists them); --set observation.n_track=.. and observation.behavior=true add "
                "columns"
            )
        calls = -(-CHUNK // (rows or CHUNK))
        graph_check.refuse_strange(graph, {name: (rows or CHUNK, n_obs)}, calls, rows or 1)
        session = graph_check.session(graph)
    except graph_check.GraphError as error:
        raise api.PluginError(f"{spec.path}: {error.reason}") from None
    except api.PluginError:
        raise
    except Exception as error:  # ONNX Runtime's own, which share no base class beyond this
        raise api.PluginError(
            f"{spec.path}: ONNX Runtime cannot use it ({' '.join(str(error).split())[:200]})"
        ) from None

    def act(obs: np.ndarray) -> np.ndarray:
        given = obs.astype(dtype, copy=False)
        if rows is None:
            return session.run([output], {name: given})[0]
        padded = np.zeros((-(-len(obs) // rows) * rows, n_obs), dtype)
        padded[: len(obs)] = given
        parts = [session.run([output], {name: part})[0] for part in np.split(padded, len(padded) // rows)]
        return np.concatenate(parts)[: len(obs)]

    return act, _hold(spec, head.metadata)


def _hold(spec: api.PluginSpec, metadata: dict[str, str]) -> int:
    text = metadata.get(HOLD, "1")
    if not text.isascii() or not text.isdigit() or not 1 <= int(text[:9]) <= 10_000:
        raise api.PluginError(
            f"{spec.path}: metadata {HOLD} = {text[:40]!r}; a whole number of control steps from 1"
        )
    return int(text)


# ---- A plugin of the user's from its name to what drives or plans in a simulator.

_CALLS: dict[str, tuple[tuple[str, ...], int, str]] = {
    api.PLANNER: (("plan",), 5, "a planner is called plan(clearance, cell_m, start, goal, forecast)"),
    api.CONTROLLER: (("act",), 1, "a controller is called act(view)"),
    api.POLICY: (("act", "predict"), 1, "a policy is called act(obs)"),
    api.REWARD: (("terms",), 1, "a reward is called terms(view)"),
    api.MOTION: ((), 0, "a motion is called paths()"),
}
"""of each kind the methods that may be called, the first that there is, their arguments, and both in words"""
_LIMITS = ("max_surge_m_s", "max_sway_m_s", "max_heave_m_s", "max_yaw_rate_rad_s")


def _say(text: str) -> None:
    print(text, file=sys.stderr)


@dataclass
class LoadedPlugin:
    """A plugin that was found: its file can be read and has what it names."""

    spec: api.PluginSpec
    sha256: str
    """of its file; what that imports is not in it"""
    found: Any
    """the object; an ONNX graph's bytes"""
    note: Callable[[str], None] = _say
    """told of calls that take too long"""
    meter: adapters.CallMeter | None = field(default=None, init=False)

    @property
    def label(self) -> str:
        """What it is called in tables."""
        return self.spec.label

    def agent(self, sim: Sim) -> adapters.PluginAgent | None:
        """Who drives this simulator; None for a planner, where the tree does. Raises PluginError."""
        if self.spec.kind == api.PLANNER:
            return None
        about = about_of(sim, self.spec.argument)
        code = self._code(sim, about)
        if self.spec.kind == api.CONTROLLER:
            return adapters.PluginAgent(
                sim, code, adapters.asking_controller(sim, code, about.columns, about.limits)
            )
        return adapters.PluginAgent(sim, code, adapters.asking_policy(code, sim.device))

    def planner(self, sim: Sim) -> RouteSource | None:
        """Who plans routes in this simulator; None where its own planner does. Raises PluginError."""
        if self.spec.kind != api.PLANNER:
            return None
        code = self._code(sim, about_of(sim, self.spec.argument))
        return RouteSource(code, sim.config.mapping.cell_m, sim.config.tracking.forecast_dt_s)

    def reward(self, env: VectorEnv) -> None:
        """Add its terms to the reward of an environment. Raises PluginError, at once or in a step."""
        sim, about = env.sim, about_of(env.sim, self.spec.argument)
        code = self._code(sim, about)
        fixed, names = adapters.Fixed(sim, about.columns, about.limits, code.marks.arrays), []

        def terms() -> dict[str, torch.Tensor]:
            assert sim.observation is not None
            view = adapters.JudgedView(sim, sim.observation.clone(), fixed, env.driven.clone())
            found = adapters.terms(
                code.called(code.act, view, sim.num_envs), sim.num_envs, code.place, sim.device
            )
            names[:] = names or [*found]
            if [*found] != names:
                raise api.PluginError(
                    f"{code.place}: gave {', '.join(found)}, and {', '.join(names)} at first"
                )
            return found

        env.add_terms(terms)

    def told(self) -> str:
        """What has to be said of its time; empty = nothing."""
        return self.meter.told() if self.meter else ""

    def close(self) -> None:
        """Nobody waits for a call any more."""
        if self.meter:
            self.meter.close()

    def saw_truth(self) -> bool:
        """Whether it was shown more than the vehicle senses."""
        return False

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

    def _code(self, sim: Sim, about: api.About) -> adapters.OwnCode:
        spec = self.spec
        # a route is planned while the vehicle drives on: its time is held against a control step all the same
        self.meter = adapters.CallMeter(spec.option, spec.path, about.dt_s, self.note)
        if not spec.is_code:
            act, hold_steps = onnx_policy(spec, self.found, about.n_obs)
            return adapters.OwnCode(
                spec, act, None, str(spec.path), adapters.Marks(hold_steps=hold_steps), self.meter
            )
        drives = made(self.found, spec, about)
        inner = inner_of(drives)
        act = agent_of(drives, spec)
        place = f"{place_of(act, spec)}: {spec.name if act is inner else getattr(act, '__name__', spec.name)}"
        marks = _marks(drives, place)
        if spec.kind == api.POLICY and getattr(act, "__name__", "") == "predict":
            act = _predicting(act)
        return adapters.OwnCode(spec, act, _reset_of(inner, self.found), place, marks, self.meter)


def load_plugin(spec: api.PluginSpec) -> LoadedPlugin:
    """The plugin of a name, refused at once where its file or object is missing. Raises PluginError,
    FileError."""
    if not spec.is_code:
        graph = graph_of(spec)
        return LoadedPlugin(spec, hashlib.sha256(graph).hexdigest(), graph)
    content = content_of(spec, MAX_BYTES)
    return LoadedPlugin(spec, hashlib.sha256(content).hexdigest(), object_of(spec))


def obstacles_of(spec: api.PluginSpec) -> list[dict[str, Any]]:
    """Explicit obstacles that a function of the user's gives, as ``world.added`` has them. PluginError,
    FileError."""
    give = agent_of(object_of(spec), spec)
    try:
        given = [dict(one) for one in give()]
    except (Exception, SystemExit) as error:
        raise api.failed(error, spec.path, spec.option) from error
    for i, one in enumerate(given):
        try:
            if (path := np.asarray(one.get("path", ()), float)).size:
                one["path"] = [{"x_m": x, "y_m": y} for x, y in path.tolist()]
                one |= {"x_m": path[0, 0], "y_m": path[0, 1]}
            given[i] = FixedObstacle.model_validate(one).model_dump(mode="json", exclude_defaults=True)
        except (TypeError, ValueError) as error:
            first = error.errors()[0] if isinstance(error, ValidationError) else {"loc": (), "msg": error}
            key, known = ".".join(map(str, first["loc"])), list(FixedObstacle.model_fields)
            like = nearest(key, known) if first.get("type") == "extra_forbidden" else ""
            reason = f"{key}: {first['msg']}{like}".lstrip(": ")
            raise api.PluginError(f"{place_of(give, spec)}: obstacle {i}: {reason}") from None
    return given


def about_of(sim: Sim, argument: str = "") -> api.About:
    """What a plugin is told before it begins."""
    config = sim.config
    placed = placed_columns(config.observation)
    columns = {column.name: slice(first, first + width) for column, first, width in placed}
    limits = np.array([getattr(config.vehicle, name) for name in _LIMITS], np.float32)
    assert len(limits) == NUM_ACTIONS
    return api.About(
        num_envs=sim.num_envs, dt_s=config.episode.control_dt_s, limits=limits, columns=columns,
        n_obs=max(place.stop for place in columns.values()), cell_m=config.mapping.cell_m,
        min_clearance_m=config.voronoi.min_clearance_m, device=sim.device.type, argument=argument,
    )  # fmt: skip


def _marks(drives: Any, place: str) -> adapters.Marks:
    """How it wants to be called; torch for a torch module that says nothing."""
    arrays = "torch" if isinstance(inner_of(drives), torch.nn.Module) else "numpy"
    found = adapters.Marks(
        *(getattr(drives, name, default) for name, default in adapters.Marks(arrays=arrays)._asdict().items())
    )
    given: Any = found
    try:
        api.plugin(*given)
    except ValueError as error:
        raise api.PluginError(f"{place}: {error}") from None
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

    def __init__(self, code: adapters.OwnCode, cell_m: float, forecast_dt_s: float) -> None:
        self.code, self._cell_m, self._dt_s = code, cell_m, forecast_dt_s
        self._wants_row = "row" in inspect.signature(code.act).parameters

    def reset(self, mask: torch.Tensor) -> None:
        self.code.forget(mask)

    def plan(self, asked: PlanRequest) -> np.ndarray | None:
        """Corners (n >= 2, 2) [m] from start to goal; None = no way. PluginError for any other answer."""
        forecast = api.Forecast(asked.obstacle, asked.radius_m, self._dt_s)
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
        return adapters.waypoints(found, (asked.start, asked.goal), size_m, self.code.place)
