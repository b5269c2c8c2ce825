"""What a controller of the user's is shown: rows of what the vehicle senses, remembers and decides, read when
it is asked for. ``FIELDS`` is the whole of it; no truth is among them (``tests/test_own_pieces.py``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from uuvtai.config import SonarConfig
from uuvtai.own.protocol import COMMAND, Ego, OccupancyGrid, Scan, Tracks, Way
from uuvtai.sim import Sim

FIELDS = {
    "goal": ("mission.goal_w",),
    "step": ("clock.step",),
    "ego": ("ego.pos_w", "ego.rpy", "ego.vel_b", "ego.rate_b", "ego.depth_m"),
    "scan": (
        "scan.range_m",
        "scan.hit",
        "scan.doppler_m_s",
        "scan.intensity",
        "scan.ping_yaw",
        "scan.ping_step",
    ),
    "tracks": ("tracks.alive", "tracks.moving", "tracks.state", "tracks.radius_m"),
    "forecast": ("forecast.pos_w", "forecast.radius_m"),
    "map": ("grid_map.static_occ", "grid_map.dynamic_occ", "clearance.clearance_m"),
    "route": (
        *("route.n_way", "route.way_w", "route.lookahead_w", "route.heading_error", "route.cross_track_m"),
        "route.remaining_m",
    ),
}
"""all that is ever read for a view"""

Array = np.ndarray


class Readings:
    """The state of chosen rows, each group read once, as NumPy copies."""

    def __init__(self, sim: Sim, rows: list[int], obs: torch.Tensor) -> None:
        """``obs`` (len(rows), n_obs): a copy that nobody else writes."""
        self.numbers, self.obs = np.asarray(rows, np.int64), obs
        self._sim, self._chosen = sim, None if len(rows) == sim.num_envs else rows
        self._known: dict[str, Any] = {}

    def group(self, name: str) -> Any:
        """A NamedTuple of the protocol, or an array."""
        if name not in self._known:
            self._known[name] = self._made(name)
        return self._known[name]

    def _read(self, name: str) -> list[Array]:
        found = []
        for path in FIELDS[name]:
            struct, _, field = path.partition(".")
            found.append(self._sim.rows(getattr(getattr(self._sim.s, struct), field), self._chosen))
        return found

    def _made(self, name: str) -> Any:
        read, dt_s = self._read(name), self._sim.config.episode.control_dt_s
        if name == "scan":
            age_s = (self.group("step") - read[5]).astype(np.float32) * np.float32(dt_s)
            return _scan(read, age_s, self._sim.config.sensors.sonar)
        if name == "tracks":
            ahead = self._read("forecast")
            moving, state = (read[0] == 1) & (read[1] == 1), read[2]
            return Tracks(moving, state[..., :2], state[..., 2:], read[3], ahead[0], ahead[1])
        kinds: dict[str, Callable[..., Any]] = {"ego": Ego, "map": OccupancyGrid, "route": Way}
        return kinds[name](*read) if name in kinds else read[0]


def _scan(read: list[Array], age_s: Array, sonar_cfg: SonarConfig) -> Scan:
    """Of what was read; a speed that is not measured is not a number."""
    range_m, hit, doppler, intensity, yaw, _step = read
    bearing = sonar_cfg.first_beam_rad + sonar_cfg.beam_step_rad * np.arange(sonar_cfg.n_ray)
    return Scan(
        range_m,
        hit == 1,
        doppler if sonar_cfg.doppler else np.full_like(doppler, np.nan),
        intensity,
        yaw,
        age_s,
        np.broadcast_to(bearing.astype(np.float32), range_m.shape).copy(),
    )


class PieceView:
    """A ``protocol.View`` of readings: the whole batch, or one row of it."""

    def __init__(self, readings: Readings, fixed: Fixed, pick: int | None = None) -> None:
        self._readings, self._fixed, self._pick = readings, fixed, pick
        self.limits, self.dt_s, self.columns = fixed.limits, fixed.dt_s, fixed.columns
        self.cell_m, self.origin = fixed.cell_m, fixed.origin

    @property
    def rows(self) -> Any:
        """(n,) numbers of the envs."""
        numbers = self._readings.numbers
        return numbers if self._pick is None else int(numbers[self._pick])

    @property
    def time_s(self) -> Any:
        """(n,) [s] since the episode began."""
        return self._given(self._readings.group("step").astype(np.float32) * np.float32(self.dt_s))

    @property
    def obs(self) -> Any:
        """(n, M) the observation."""
        found = self._readings.obs
        found = found if self._pick is None else found[self._pick]
        return found if self._fixed.torch else found.cpu().numpy()

    @property
    def goal(self) -> Any:
        """(n, 3) [m] world."""
        return self._given(self._readings.group("goal"))

    @property
    def ego(self) -> Ego:
        """What the vehicle knows of itself."""
        return self._group("ego")

    @property
    def scan(self) -> Scan:
        """The newest sonar scan."""
        return self._group("scan")

    @property
    def tracks(self) -> Tracks:
        """Forecast that the tracker follows."""
        return self._group("tracks")

    @property
    def map(self) -> OccupancyGrid:
        """The map."""
        return self._group("map")

    @property
    def route(self) -> Way:
        """The route."""
        return self._group("route")

    def __getitem__(self, column: str) -> Any:
        """Columns of the observation by name (n, width). KeyError says which there are."""
        if column not in self.columns:
            raise KeyError(f"no column {column!r}; there are {', '.join(self.columns)}")
        return self.obs[..., self.columns[column]]

    def in_body(self, vectors_w: Any) -> Any:
        """World vectors (n, 2 or 3) turned by the own yaw: ahead, left(, up)."""
        yaw = self.ego.rpy[..., 2]
        sine, cosine = (torch.sin(yaw), torch.cos(yaw)) if self._fixed.torch else (np.sin(yaw), np.cos(yaw))
        x, y = vectors_w[..., 0], vectors_w[..., 1]
        parts = [cosine * x + sine * y, cosine * y - sine * x]
        parts += [vectors_w[..., 2]] if vectors_w.shape[-1] == 3 else []
        return torch.stack(parts, -1) if self._fixed.torch else np.stack(parts, -1)

    def __repr__(self) -> str:
        """What there is."""
        return (
            f"View(rows={self.rows}, columns: {', '.join(self.columns)}; obs, goal, time_s, ego, scan, "
            f"tracks, map, route; a command is {COMMAND})"
        )

    def _group(self, name: str) -> Any:
        found = self._readings.group(name)
        return type(found)(*(self._given(values) for values in found))

    def _given(self, values: Array) -> Any:
        picked = values if self._pick is None else values[self._pick]
        return torch.as_tensor(picked, device=self._fixed.device) if self._fixed.torch else picked


class Fixed:
    """What a view says of every env and every step."""

    def __init__(self, sim: Sim, columns: Mapping[str, slice], limits: Array, arrays: str) -> None:
        self.torch, self.device = arrays == "torch", sim.device
        self.columns, self.dt_s = columns, sim.config.episode.control_dt_s
        self.limits = torch.as_tensor(limits, device=sim.device) if self.torch else limits
        self.cell_m, self.origin = sim.config.mapping.cell_m, sim.fallback.origin
