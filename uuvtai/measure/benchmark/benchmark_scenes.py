"""The scenes of ``uuv benchmark``. They are fixed: whoever changes one raises ``VERSION``, and old entries
are of another benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from uuvtai.scene_options import SceneOptions

if TYPE_CHECKING:
    from uuvtai.config import Config

VERSION = 1
SEED = 91001
"""of an entry's episodes, 0 .. ``EPISODES`` - 1; nobody tunes on it"""
EPISODES = 100
TRIAL_SEED, TRIAL_EPISODES = 77001, 4
"""of ``--quick``: episodes that anybody may look at and tune on"""
ALL = "all"
"""every scene, one after the other"""
SENSORS = "paper"
COLUMNS = ("episode", "outcome", "time_s", "min_clearance_m", "path_length_m")
"""of an entry's episodes"""


@dataclass(frozen=True)
class BenchmarkScene:
    """One condition, with its number of resting (S) and moving obstacles (D) and their speed v."""

    name: str
    world: str
    n_static: int
    n_dynamic: int
    speed_m_s: float | None
    """None = nothing moves"""
    about: str
    overrides: tuple[str, ...] = ()
    """further settings, as ``--set`` has them"""

    def options(self) -> SceneOptions:
        """What a command line would say."""
        return SceneOptions(
            world=self.world,
            sensors=SENSORS,
            n_static=self.n_static,
            n_dynamic=self.n_dynamic,
            speed_m_s=self.speed_m_s,
            overrides=self.overrides,
        )

    def config(self) -> Config:
        """The condition as a config, whoever drives."""
        return _config_of(self)

    def document(self) -> dict[str, Any]:
        """A row of ``uuv benchmark --json``."""
        return {
            "name": self.name,
            "world": self.world,
            "S": self.n_static,
            "D": self.n_dynamic,
            "v_m_s": self.speed_m_s,
            "sensors": SENSORS,
            "about": self.about,
        }


@lru_cache(maxsize=32)
def _config_of(bench: BenchmarkScene) -> Config:
    return bench.options().config()


SCENES = (
    BenchmarkScene("pool", "pool", 8, 6, 0.6, "the paper's scene: slow bodies in a tank"),
    BenchmarkScene("pool-fast", "pool", 8, 9, 1.5, "more bodies, faster than the vehicle"),
    BenchmarkScene("gauntlet-fast", "gauntlet", 8, 9, 1.5, "large bodies with sharp, unannounced turns"),
    BenchmarkScene("maze", "maze", 8, 6, 0.6, "a slalom around three walls, among slow bodies"),
    BenchmarkScene("netpen", "netpen", 6, 5, 0.4, "a round fish pen with moorings and schools"),
    BenchmarkScene("column", "column", 8, 9, 1.5, "fast bodies with no way over or under them"),
    BenchmarkScene(
        "crossing", "crossing", 10, 0, None, "ten resting cylinders, after a published BlueROV2 study"
    ),
)

NAMES = (*(bench.name for bench in SCENES), ALL)
"""what may be entered"""


def scenes_of(name: str) -> list[BenchmarkScene]:
    """The scenes of a benchmark's name. Raises ConfigError for one that there is not."""
    from uuvtai.loader import ConfigError, nearest  # not with every --help

    found = [bench for bench in SCENES if name in (bench.name, ALL)]
    if not found:
        names = list(NAMES)
        raise ConfigError(
            f"{name!r} is no benchmark{nearest(name, names)}; there are: {', '.join(names)} (see 'uuv "
            "benchmark'), and 'uuv benchmark verify FILE' checks an entry"
        )
    return found


def catalogue() -> dict[str, Any]:
    """The document of ``uuv benchmark --json``."""
    return {
        "schema": 1,
        "version": VERSION,
        "seed": SEED,
        "episodes": EPISODES,
        "benchmarks": [bench.document() for bench in SCENES],
    }
