"""What a log is made of: an episode's header, and one control step at a time as the state's own rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

from uuvtai.config import Config
from uuvtai.outcomes import RUNNING
from uuvtai.version import __version__

Values = Mapping[str, Any]
"""One env at one control step: 'struct.field' of the state -> copy of the env's row (shapes, units and frames
as in ``state``), and below 'driver.' what drives it: ``applied``, the action (4,) that led here, and of a
policy ``action`` (4,), ``value``, ``std`` (4,), ``distill_lambda``, ``residual`` and ``uncertainty``, each
None where there is none."""


@dataclass(frozen=True, eq=False)
class EpisodeHeader:
    """What is known before the first step; it comes first in the log."""

    controller: str
    """name of the method that drives: 'bt', 'planner', 'straight' or a policy's name"""
    config: Config
    config_yaml: str
    """the same as text"""
    scenario: dict[str, Any]
    """of ``scenario_document``: everything true about the world, in closed form"""
    reward_terms: tuple[str, ...] = ()
    """names of ``reward.term``'s entries"""
    tree_nodes: tuple[str, ...] = ()
    """names of ``teacher.status``'s entries; numbered by the log where two are equal"""
    tree_xml: bytes = b""
    """the tree as it was read; empty = unknown"""
    git_sha: str = "unknown"
    checkpoint_sha256: str = ""
    """of the policy's checkpoint; empty = no policy"""
    version: str = __version__

    @cached_property
    def nodes(self) -> tuple[str, ...]:
        """Names of the tree's nodes."""
        return numbered(self.tree_nodes)


def numbered(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of a tree's nodes, where two are equal with their number: 'Hold', 'Hold#7'."""
    return tuple(name if names.index(name) == i else f"{name}#{i}" for i, name in enumerate(names))


class EpisodeEnd(Protocol):
    """How the episode ended: the last thing in the log."""

    @property
    def outcome(self) -> str: ...
    @property
    def episode_return(self) -> float: ...
    @property
    def time_s(self) -> float: ...
    @property
    def min_clearance_m(self) -> float: ...
    @property
    def replans(self) -> dict[str, int]: ...
    @property
    def planned_by(self) -> dict[str, int]: ...


@dataclass(frozen=True, eq=False)
class Moment:
    """One control step, the reset (step 0) included, as encoders see it: ``moment['ego.pos_w']``."""

    header: EpisodeHeader
    values: Values

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    @cached_property
    def step(self) -> int:
        """Control steps since the start."""
        return int(self["clock.step"])

    @cached_property
    def time_s(self) -> float:
        """Simulation time."""
        return self.step * self.header.config.episode.control_dt_s

    @cached_property
    def time_ns(self) -> int:
        """Simulation time."""
        return self.ns_of(self.step)

    @cached_property
    def stamp(self) -> str:
        """Simulation time as a foxglove time."""
        return time_text(self.time_ns)

    def stamp_of(self, step: int) -> str:
        """Time of another step as a foxglove time."""
        return time_text(self.ns_of(step))

    def ns_of(self, step: int) -> int:
        """Time of a step [ns]."""
        return round(step * self.header.config.episode.control_dt_s * 1e9)

    @property
    def ended(self) -> bool:
        """The episode ended in this step: nothing follows."""
        return int(self["referee.outcome"]) != RUNNING

    @property
    def replanned(self) -> bool:
        """The route was planned in this step."""
        return bool(self["route.n_way"] > 0 and self["route.plan_step"] == self.step)


def time_text(time_ns: int) -> str:
    """foxglove time."""
    return '{"sec":%d,"nsec":%d}' % divmod(time_ns, 1_000_000_000)  # noqa: UP031
