"""Configuration: one frozen section per stage noun. Unknown keys, wrong types, NaN and nonsense sizes are
errors.

YAML in and out, and presets, live in ``loader.py``; what training adds is in ``config/learning.py``.
"""

from __future__ import annotations

from pydantic import model_validator

from uuvtai.config.base import Section
from uuvtai.config.behavior import BehaviorConfig, FastConfig, SlowConfig
from uuvtai.config.perception import (
    CameraTrackingConfig,
    ForecastConfig,
    HeightConfig,
    LocalizationConfig,
    MappingConfig,
    TrackingConfig,
)
from uuvtai.config.planning import (
    BaselinesConfig,
    ClearanceConfig,
    DynamicWindowConfig,
    ObservationConfig,
    PathIntegralConfig,
    QuietConfig,
    RouteConfig,
    VoronoiConfig,
)
from uuvtai.config.sensors import (
    DepthConfig,
    DvlConfig,
    ImuConfig,
    PressureConfig,
    SensorsConfig,
    SonarConfig,
)
from uuvtai.config.task import EpisodeConfig, RewardConfig
from uuvtai.config.vehicle import ActuationConfig, DisturbanceConfig, Thruster, VehicleConfig, instability
from uuvtai.config.world import (
    DynamicObstacles,
    FixedObstacle,
    StaticObstacles,
    TankConfig,
    TrafficConfig,
    Waypoint,
    WorldConfig,
)


class RuntimeConfig(Section):
    """How kernels are launched."""

    native: bool = True
    """by machine code of their own, kept on disk, not by Taichi (CPU, Linux): ``docs/performance.md``"""


MOST_CELLS = 4_000_000
"""of a map"""


class Config(Section):
    """Everything a run needs; immutable."""

    world: WorldConfig = WorldConfig()
    vehicle: VehicleConfig = VehicleConfig()
    actuation: ActuationConfig = ActuationConfig()
    disturbance: DisturbanceConfig = DisturbanceConfig()
    sensors: SensorsConfig = SensorsConfig()
    traffic: TrafficConfig = TrafficConfig()
    localization: LocalizationConfig = LocalizationConfig()
    tracking: TrackingConfig = TrackingConfig()
    forecast: ForecastConfig = ForecastConfig()
    height: HeightConfig = HeightConfig()
    camera_tracking: CameraTrackingConfig = CameraTrackingConfig()
    mapping: MappingConfig = MappingConfig()
    clearance: ClearanceConfig = ClearanceConfig()
    voronoi: VoronoiConfig = VoronoiConfig()
    quiet: QuietConfig = QuietConfig()
    route: RouteConfig = RouteConfig()
    observation: ObservationConfig = ObservationConfig()
    behavior: BehaviorConfig = BehaviorConfig()
    slow: SlowConfig = SlowConfig()
    fast: FastConfig = FastConfig()
    baselines: BaselinesConfig = BaselinesConfig()
    reward: RewardConfig = RewardConfig()
    episode: EpisodeConfig = EpisodeConfig()
    runtime: RuntimeConfig = RuntimeConfig()

    @model_validator(mode="after")
    def _can_be_simulated(self) -> Config:
        (x_low, x_high), (y_low, y_high) = self.world.tank.x_m, self.world.tank.y_m
        n_cell = round((x_high - x_low) * (y_high - y_low) / self.mapping.cell_m**2)
        if n_cell > MOST_CELLS:
            raise ValueError(
                f"mapping.cell_m: a map of this tank has {n_cell:,} cells of {self.mapping.cell_m:g} m, more "
                f"than {MOST_CELLS:,}; give a larger cell or a smaller tank"
            )
        substep_s = self.episode.control_dt_s / self.episode.substeps
        if why := instability(self.vehicle, self.actuation, self.disturbance, substep_s):
            raise ValueError(f"vehicle: {why}")
        return self


__all__ = [
    "ActuationConfig", "BaselinesConfig", "BehaviorConfig", "CameraTrackingConfig", "ClearanceConfig",
    "Config", "DepthConfig", "DisturbanceConfig", "DvlConfig", "DynamicObstacles", "DynamicWindowConfig",
    "EpisodeConfig", "FastConfig", "FixedObstacle", "ForecastConfig", "HeightConfig", "ImuConfig",
    "LocalizationConfig", "MappingConfig", "ObservationConfig", "PathIntegralConfig",
    "PressureConfig", "QuietConfig", "RewardConfig", "RouteConfig", "RuntimeConfig", "Section",
    "SensorsConfig", "SlowConfig", "SonarConfig", "StaticObstacles", "TankConfig", "Thruster",
    "TrackingConfig", "TrafficConfig", "VehicleConfig", "VoronoiConfig", "Waypoint",
    "WorldConfig",
]  # fmt: skip
