"""Bundles are filled by type, and what does not fit is told."""

from __future__ import annotations

import dataclasses

import pytest

from uuvtai.config import Config, SonarConfig, TankConfig
from uuvtai.kernels.core.stage import Const, Out
from uuvtai.sim.stages import bind, bind_all, members_of


@dataclasses.dataclass(frozen=True, eq=False)
class Echo:
    """A struct."""

    value: object


@dataclasses.dataclass(frozen=True, eq=False)
class EchoIO:
    """A bundle."""

    echo: Out[Echo]
    sonar_cfg: Const[SonarConfig]
    tank_cfg: Const[TankConfig]


@dataclasses.dataclass(frozen=True, eq=False)
class LooseIO:
    """A member that says neither in nor out."""

    echo: Echo


@dataclasses.dataclass(frozen=True)
class State:
    """Structs of a simulator."""

    echo: Echo


@dataclasses.dataclass(frozen=True)
class AllIO:
    """Bundles of a simulator."""

    echo: EchoIO


def test_sections_are_found_wherever_they_lie_in_a_config():
    config, echo = Config(), Echo(1)
    for source in (echo, State(echo)):
        io = bind(EchoIO, source, config)
        assert io.echo is echo and io.sonar_cfg is config.sensors.sonar and io.tank_cfg is config.world.tank
    assert bind_all(AllIO, State(echo), config).echo.echo is echo
    assert bind(EchoIO, io, echo).sonar_cfg is config.sensors.sonar, "from another bundle"


def test_what_nobody_gives_is_named():
    with pytest.raises(TypeError, match="EchoIO needs Echo, TankConfig: pass them too"):
        bind(EchoIO, SonarConfig())
    assert bind(EchoIO, SonarConfig(), partial=True).echo is None


def test_two_of_one_type_are_refused_and_one_given_twice_is_not():
    echo = Echo(1)
    with pytest.raises(TypeError, match="two different Echo to bind"):
        bind(EchoIO, echo, Echo(2), Config())
    assert bind(EchoIO, echo, echo, Config()).echo is echo


def test_a_member_says_how_it_is_used():
    assert members_of(EchoIO) == {"echo": "Echo", "sonar_cfg": "SonarConfig", "tank_cfg": "TankConfig"}
    with pytest.raises(TypeError, match=r"LooseIO.echo: Echo is none of In\[..\], Out\[..\] and Const\[..\]"):
        members_of(LooseIO)
