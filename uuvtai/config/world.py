"""The water, what stands and moves in it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from uuvtai.common.enums import Truth
from uuvtai.config.base import (
    Count,
    Fraction,
    Interval,
    NonNegative,
    OrderedInterval,
    Positive,
    PositiveInterval,
    Real,
    Section,
    Vector3,
)

if TYPE_CHECKING:
    import numpy as np

_LONGEST_M, _MOST_AREA_M2, _DEEPEST_M = 1000.0, 40_000.0, 100.0
_MOST_CORNERS = 64


class TankConfig(Section):
    """Known bounds of the water."""

    shape: Literal["rectangle", "circle"] = "rectangle"
    x_m: Interval = (0.0, 20.0)
    y_m: Interval = (0.0, 6.0)
    z_m: Interval = (-1.6, 0.0)
    """floor and surface"""
    heading_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """compass heading of the x axis, for ``uuv pilot`` unless --heading says; null: where the vehicle looks
    first"""

    @model_validator(mode="after")
    def _ordered(self) -> TankConfig:
        for name in ("x_m", "y_m", "z_m"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name} must be (low, high) with low < high, got {getattr(self, name)}")
        x, y, z = (high - low for low, high in (self.x_m, self.y_m, self.z_m))
        if max(x, y) > _LONGEST_M or x * y > _MOST_AREA_M2 or z > _DEEPEST_M:
            raise ValueError(
                f"is {x:g} x {y:g} x {z:g} m, and a tank has at most {_LONGEST_M:,.0f} m, "
                f"{_MOST_AREA_M2:,.0f} m^2 and a depth of {_DEEPEST_M:,.0f} m; sizes are in metres"
            )
        return self

    def holds(self, x_m: float, y_m: float) -> bool:
        """Whether a place is within the walls, or on them."""
        return bool(self.from_wall(x_m, y_m) >= -1e-6)

    def from_wall(self, x_m: np.ndarray | float, y_m: np.ndarray | float) -> np.ndarray:
        """[m] from places to the nearest side wall; negative outside."""
        import numpy as np  # not for the commands that read presets

        (x_low, x_high), (y_low, y_high) = self.x_m, self.y_m
        if self.shape == "circle":
            off = np.hypot(x_m - 0.5 * (x_low + x_high), y_m - 0.5 * (y_low + y_high))
            return self.radius_m - off
        return np.minimum(np.minimum(x_m - x_low, x_high - x_m), np.minimum(y_m - y_low, y_high - y_m))

    @property
    def radius_m(self) -> float:
        """Radius of the inscribed circle (the wall of a circular tank)."""
        return 0.5 * min(self.x_m[1] - self.x_m[0], self.y_m[1] - self.y_m[0])


class StaticObstacles(Section):
    """Random static obstacles: vertical cylinders and boxes through the full water column, anywhere within
    the side walls."""

    radius_m: PositiveInterval = (0.2, 0.4)
    half_extent_m: PositiveInterval = (0.2, 0.5)
    box_fraction: Fraction = 0.5
    """by index, so that half are exactly half of an even number"""
    gap_m: NonNegative = 0.9
    """between surfaces"""
    endpoint_gap_m: NonNegative = 0.8
    """from start and goal to the surface"""
    joined_clearance_m: NonNegative = 0.45
    """start and goal must be joined by free space with this clearance, else the layout is drawn again"""


class DynamicObstacles(Section):
    """Random moving obstacles."""

    radius_m: PositiveInterval = (0.15, 0.25)
    height_m: PositiveInterval = (0.3, 0.5)
    z_m: OrderedInterval = (-1.2, -0.4)
    cylinder_fraction: Fraction = 0.5
    """the others are spheres"""
    full_column_fraction: Fraction = 0.0
    """share of the moving obstacles that are cylinders through the full water column (counted within
    cylinder_fraction)"""
    motion: Literal["line_circle", "waypoints"] = "line_circle"
    circle_fraction: Fraction = 0.5
    """the others go back and forth on a line"""
    line_length_m: PositiveInterval = (2.0, 6.0)
    circle_radius_m: PositiveInterval = (0.5, 2.0)
    corners: tuple[Count, Count] = (3, 5)
    corner_gap_m: NonNegative = 2.0
    """between any two corners of one path"""
    keep_clear_draws: Count = 16
    """draws of a path that keeps clear of static obstacles before the last one is taken as it is (0: the
    first); walls are always kept"""
    start_gap_m: NonNegative = 1.5
    """horizontal, centre to centre, at t = 0; always kept"""

    @model_validator(mode="after")
    def _consistent(self) -> DynamicObstacles:
        low, high = self.corners
        if not 2 <= low <= high <= 5:
            raise ValueError(f"corners must be (low, high) within 2 to 5, got {self.corners}")
        if self.full_column_fraction > self.cylinder_fraction:
            raise ValueError("full_column_fraction counts within cylinder_fraction and cannot exceed it")
        return self


class Waypoint(Section):
    """One corner of an explicit obstacle's closed path."""

    x_m: Real
    y_m: Real


class FixedObstacle(Section):
    """An obstacle that is always there, given explicitly; with ``path`` it moves along the closed
    polyline."""

    kind: Literal["sphere", "cylinder", "box"]
    x_m: Real
    y_m: Real
    z_m: Real | None = None
    """centre; default: middle of the water column"""
    radius_m: Positive | None = None
    half_extents_m: tuple[Positive, Positive] | None = None
    height_m: Positive | None = None
    """default: the full water column"""
    yaw_deg: Real = 0.0
    path: tuple[Waypoint, ...] = ()
    """2 to 64 corners; 2 = back and forth"""
    speed_m_s: NonNegative | None = None
    """default: the scenario's v"""

    @model_validator(mode="after")
    def _complete(self) -> FixedObstacle:
        if self.kind == "box" and self.half_extents_m is None:
            raise ValueError("a box needs half_extents_m: [x, y]")
        if self.kind != "box" and self.radius_m is None:
            raise ValueError(f"a {self.kind} needs radius_m")
        if len(self.path) == 1 or len(self.path) > _MOST_CORNERS:
            raise ValueError(f"path must have 2 to {_MOST_CORNERS} waypoints (2 = back and forth)")
        if any((a.x_m, a.y_m) == (b.x_m, b.y_m) for a, b in zip(self.path, self.path[1:], strict=False)):
            raise ValueError("neighbouring waypoints of a path must differ")
        return self


class OccupancyPicture(Section):
    """A map as map_server of ROS has it: dark pixels are obstacles through the full water column."""

    image: str
    """PNG or PGM, beside the file that names it"""
    resolution: Annotated[float, Field(ge=0.001, le=10)]
    """[m] a pixel"""
    origin: Vector3 = (0.0, 0.0, 0.0)
    """x, y of the lower left corner [m], and how far the picture is turned about it [rad]"""
    negate: bool | Literal[0, 1] = False
    """light pixels are obstacles"""
    occupied_thresh: Fraction = 0.65
    """darkness beyond which a pixel is one"""
    free_thresh: Fraction = 0.196
    """what is between the two is unknown to map_server, and free water here"""

    def outlines(self, tank: TankConfig) -> Iterator[list[np.ndarray]]:
        """Rings (n, 2) [m] of what it shows inside the tank: of each obstacle the outline and its holes."""
        import numpy as np

        from uuvtai.config import shapes

        bright = shapes.read_picture(self.image)
        dark = (bright if self.negate else 255 - bright) > 255 * self.occupied_thresh
        x0, y0, yaw = self.origin
        turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])

        def placed(pixels: np.ndarray) -> np.ndarray:
            return np.asarray(pixels) * self.resolution @ turn + (x0, y0)

        for row in range(len(dark)):
            columns = np.flatnonzero(dark[row])
            x, y = placed(np.column_stack([columns + 0.5, np.full(len(columns), len(dark) - row - 0.5)])).T
            dark[row, columns] = tank.from_wall(x, y) > 0
        return ([placed(ring) for ring in rings] for rings in shapes.outlines_of(dark))


def _roomy(count: int) -> int:
    """The next multiple of 16, at least 16: an empty slot costs next to nothing, another size compiles."""
    return 16 * max(1, -(-count // 16))


class WorldConfig(Section, Truth):
    """Tank, spawn ranges and obstacles: with (seed, episode) it defines a scenario completely."""

    tank: TankConfig = TankConfig()
    spawn_x_m: OrderedInterval = (2.0, 18.0)
    spawn_y_m: OrderedInterval = (1.2, 4.8)
    spawn_z_m: OrderedInterval = (-1.2, -0.4)
    start_goal_gap_m: NonNegative = 3.0
    """horizontal, so the 3-D distance is never less"""
    n_static: Count = 8
    """S"""
    n_dynamic: Count = 6
    """D"""
    dynamic_speed_m_s: NonNegative = 0.6
    """v"""
    obstacle_acceleration_m_s2: NonNegative = 0.0
    """of moving obstacles, which turn and reverse on parabolas; 0 = at once"""
    static_capacity: Count | None = None
    """slots kept for static obstacles, so that S can vary without recompilation; default n_static, rounded up
    to a multiple of 16"""
    dynamic_capacity: Count | None = None
    static: StaticObstacles = StaticObstacles()
    dynamic: DynamicObstacles = DynamicObstacles()
    fixed: tuple[FixedObstacle, ...] = ()
    added: tuple[FixedObstacle, ...] = ()
    """more of them: a world keeps those of the one that it extends, and --motion adds its own"""
    polygons: tuple[tuple[tuple[Real, Real], ...], ...] = ()
    """outlines of obstacles through the full water column, each a list of corners [x, y] in metres; they
    become boxes of ``fixed``"""
    occupancy: OccupancyPicture | None = None
    """a picture of obstacles, which become boxes of ``fixed`` too"""

    @model_validator(mode="after")
    def _boxed(self) -> WorldConfig:
        """All that is explicit in ``fixed``, outlines and pictures as boxes: nothing else knows them."""
        if not (self.added or self.polygons or self.occupancy):
            return self
        import numpy as np

        from uuvtai.config import shapes

        shown = self.occupancy.outlines(self.tank) if self.occupancy else ()
        fine_m = self.occupancy.resolution if self.occupancy else 0.0
        given = [(f"polygons.{i}", [np.array(corners)], 0.025) for i, corners in enumerate(self.polygons)]
        for i, one in enumerate(self.added):
            self._check_place(f"added.{i}", one)
        name, boxes = "", []
        for name, rings, tolerance_m in (*given, *(("occupancy", rings, fine_m) for rings in shown)):
            if away := [at for at in rings[0].tolist() if not self.tank.holds(*at)][: name != "occupancy"]:
                raise ValueError(f"{name}: {away[0]} is outside the tank; corners are in metres")
            boxes += shapes.boxes_of(name, rings, tolerance_m)
            if len(boxes) > shapes.MAX_BOXES:
                raise ValueError(f"{name}: needs more than {shapes.MAX_BOXES} boxes: straighten outlines")
        if self.occupancy and name != "occupancy":
            raise ValueError("occupancy: shows nothing in the tank; look at resolution, origin and negate")
        fixed = [
            FixedObstacle(kind="box", x_m=x, y_m=y, half_extents_m=(a, b), yaw_deg=yaw)
            for x, y, a, b, yaw in boxes
        ]
        all_of = {"fixed": (*self.fixed, *self.added, *fixed), "added": (), "polygons": (), "occupancy": None}
        self.__dict__.update(all_of)  # a frozen section is still being made here
        return self

    @model_validator(mode="after")
    def _fits(self) -> WorldConfig:
        for wanted, slots in (("n_static", "static_capacity"), ("n_dynamic", "dynamic_capacity")):
            capacity = getattr(self, slots)
            if capacity is not None and capacity < getattr(self, wanted):
                raise ValueError(f"{slots} {capacity} is less than {wanted} {getattr(self, wanted)}")
        for axis in ("x", "y", "z"):
            (low, high), (start, end) = getattr(self.tank, f"{axis}_m"), getattr(self, f"spawn_{axis}_m")
            if start < low or end > high:
                raise ValueError(
                    f"spawn_{axis}_m: ({start:g}, {end:g}), where start and goal are drawn, reaches out of "
                    f"tank.{axis}_m ({low:g}, {high:g}); give it beside the tank"
                )
        for i, obstacle in enumerate(self.fixed):
            self._check_place(f"fixed.{i}", obstacle)
            if self.obstacle_acceleration_m_s2 and obstacle.path and obstacle.path[0] == obstacle.path[-1]:
                raise ValueError(f"fixed.{i}.path closes by itself: leave its last waypoint out")
        return self

    def _check_place(self, name: str, obstacle: FixedObstacle) -> None:
        """ValueError for an explicit obstacle that is not, or does not stay, in the water."""
        tank, (floor, surface) = self.tank, self.tank.z_m
        places = [(name, obstacle), *((f"{name}.path.{i}", way) for i, way in enumerate(obstacle.path))]
        for place, where in places:
            if not tank.holds(where.x_m, where.y_m):
                raise ValueError(
                    f"{place}: ({where.x_m:g}, {where.y_m:g}) is outside the tank, x {tank.x_m}, y "
                    f"{tank.y_m}, {tank.shape}; places are in metres"
                )
        half = obstacle.radius_m if obstacle.kind == "sphere" else 0.5 * (obstacle.height_m or 0.0)
        if obstacle.z_m is not None and not floor <= obstacle.z_m <= surface:
            raise ValueError(f"{name}.z_m: {obstacle.z_m:g} is outside the water, z {tank.z_m}")
        across = max(obstacle.half_extents_m or (obstacle.radius_m or 0.0,))
        most = max(tank.x_m[1] - tank.x_m[0], tank.y_m[1] - tank.y_m[0])
        if across > most or (half or 0.0) > surface - floor:
            raise ValueError(f"{name}: is larger than the tank; sizes are in metres")

    def center_and_size(self, obstacle: FixedObstacle) -> tuple[float, tuple[float, float, float]]:
        """(z of the centre, size) [m] of an explicit obstacle: half extents; radii and half height."""
        floor, surface = self.tank.z_m
        z = 0.5 * (floor + surface) if obstacle.z_m is None else obstacle.z_m
        half_height = 0.5 * (surface - floor if obstacle.height_m is None else obstacle.height_m)
        radius = obstacle.radius_m or 0.0
        if obstacle.kind == "box":
            return z, (*(obstacle.half_extents_m or (0.0, 0.0)), half_height)
        return z, (radius, radius, radius if obstacle.kind == "sphere" else half_height)

    @property
    def own_scene(self) -> tuple[int, int, float]:
        """(S, D, v [m/s]): numbers of its obstacles, and the speed of those that move."""
        return self.n_static, self.n_dynamic, self.dynamic_speed_m_s

    @property
    def static_slots(self) -> int:
        """Slots kept for random static obstacles."""
        return _roomy(self.n_static) if self.static_capacity is None else self.static_capacity

    @property
    def dynamic_slots(self) -> int:
        """Slots kept for random moving obstacles."""
        return _roomy(self.n_dynamic) if self.dynamic_capacity is None else self.dynamic_capacity

    def compiled(self) -> WorldConfig:
        """What kernels are compiled for: slots instead of S, D and v, which each env's scene has."""
        static, dynamic = self.static_slots, self.dynamic_slots
        return self.model_copy(
            update={
                "n_static": static, "static_capacity": static,
                "n_dynamic": dynamic, "dynamic_capacity": dynamic, "dynamic_speed_m_s": 0.0,
            }
        )  # fmt: skip

    @property
    def obstacles(self) -> dict[str, int]:
        """Numbers of all its obstacles, S static and D moving, and how many of each are explicit."""
        fixed_static, fixed_moving = self.n_fixed_static, self.n_fixed_moving
        all_of = {"S": self.n_static + fixed_static, "D": self.n_dynamic + fixed_moving}
        return all_of | {"fixed_static": fixed_static, "fixed_moving": fixed_moving}

    @property
    def n_fixed_static(self) -> int:
        """Explicit obstacles that stand still."""
        return sum(not obstacle.path for obstacle in self.fixed)

    @property
    def n_fixed_moving(self) -> int:
        """Explicit obstacles that move."""
        return sum(bool(obstacle.path) for obstacle in self.fixed)


class TrafficConfig(Section):
    """A prior, as an operator can give it who knows the water: where moving obstacles swim and how they turn.

    It says nothing of any single episode. Worlds whose obstacles are others state their own
    (``worlds/*.yaml``), with the share that fills the whole water (``height.column_share``); what is seen
    counts beside it.
    """

    z_m: OrderedInterval = (-1.2, -0.4)
    """heights of their centres, equally likely"""
    height_m: PositiveInterval = (0.3, 0.5)
    """from top to bottom"""
    leg_m: PositiveInterval = (2.0, 6.0)
    """straight ways between two turns back, equally likely"""
