"""Options that several commands share, as one parameter: ``grouped`` spreads a group's options out for Typer
and hands the command the group, filled.

A group is a dataclass whose fields are annotated as options are (``options.py``); a field that is not
annotated so cannot be typed and keeps its default.
"""

from __future__ import annotations

import functools
import inspect
import json
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_origin, get_type_hints

import typer

from uuvtai.common.exits import UsageError, say
from uuvtai.console import options as opt
from uuvtai.console import parsing
from uuvtai.console.screen import Screen
from uuvtai.sim.scene import SceneOptions, Setting

if TYPE_CHECKING:
    from uuvtai.config import Config
    from uuvtai.evaluation.simulate import Trial
    from uuvtai.evaluation.sweep import Engine
    from uuvtai.vehicle.control_loop import FlightPlan
    from uuvtai.vehicle.replay import Faults
    from uuvtai.vehicle.sitl import SitlPlan

_F = TypeVar("_F", bound=Callable[..., None])


def grouped(command: _F) -> _F:
    """The command as Typer is to see it: each option of its groups by itself, those of the output last."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: kind for name, kind in hints.items() if is_dataclass(kind)}
    given = list(inspect.signature(command).parameters.values())
    given.sort(key=lambda each: issubclass(groups.get(each.name, object), OutputGroup))  # last in the help
    parameters = [own for each in given for own in _spread(each, hints[each.name], groups)]

    @functools.wraps(command)
    def spread_out(**typed: Any) -> None:
        filled = {
            name: kind(**{own: typed.pop(own) for own in _annotated(kind)}) for name, kind in groups.items()
        }
        command(**typed, **filled)

    spread_out.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    spread_out.__annotations__ = {each.name: each.annotation for each in parameters}
    return spread_out  # type: ignore[return-value]


def _annotated(group: Any) -> dict[str, Any]:
    """Annotations of the fields that can be typed."""
    hints = get_type_hints(group, include_extras=True)
    return {
        each.name: hints[each.name] for each in fields(group) if get_origin(hints[each.name]) is Annotated
    }


def _spread(parameter: inspect.Parameter, hint: Any, groups: dict[str, Any]) -> list[inspect.Parameter]:
    group = groups.get(parameter.name)
    if group is None:
        return [parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY)]
    defaults = {
        each.name: inspect.Parameter.empty if each.default is MISSING else each.default
        for each in fields(group)
    }
    return [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=defaults[name], annotation=kind)
        for name, kind in _annotated(group).items()
    ]


# ------------------------------------------------------------------------------------------------ the groups


class _Moving(SceneOptions):
    """With obstacles that a function of the user's gives."""

    motion: str | None

    @property
    def settings(self) -> list[Setting]:
        return [*parsing.motion(self.motion), *super().settings]


@dataclass(frozen=True)
class SceneGroup(_Moving):
    """Where, and with which vehicle."""

    world: opt.World = "pool"
    sensors: opt.Sensors = None
    vehicle: opt.Vehicle = None
    n_static: opt.Static = None
    n_dynamic: opt.Dynamic = None
    speed_m_s: opt.Speed = None
    motion: opt.Motion = None
    overrides: opt.Set = None


@dataclass(frozen=True)
class ProfileSceneGroup(SceneOptions):
    """Where, and with which vehicle, an agent is timed."""

    world: opt.World = "pool"
    sensors: opt.Sensors = None
    vehicle: opt.Vehicle = None
    overrides: opt.Set = None


@dataclass(frozen=True)
class TrainSceneGroup(_Moving):
    """What is not typed is the training preset's."""

    world: opt.TrainWorld = None
    sensors: opt.TrainSensors = None
    n_static: opt.Static = None
    n_dynamic: opt.Dynamic = None
    speed_m_s: opt.Speed = None
    motion: opt.Motion = None
    overrides: opt.Set = None


@dataclass(frozen=True)
class AgentsGroup:
    """Who drives, in every table of an evaluation."""

    agent: opt.Agents = None
    planner: opt.Planners = None
    default = ("straight", "planner", "bt")

    def named(self) -> list[str]:
        """All of them; the default where nobody is typed. UsageError."""
        return parsing.agents(self.agent, self.planner, self.default)


@dataclass(frozen=True)
class AgentsOrTreeGroup(AgentsGroup):
    """As ``AgentsGroup``; by default the tree alone."""

    agent: opt.AgentsOrTree = None
    default = ("bt",)


@dataclass(frozen=True)
class AgentGroup:
    """Who drives one vehicle."""

    agent: opt.SimulateAgent = None
    planner: opt.Planners = None

    @property
    def one(self) -> str | None:
        """Its name; None = nobody. UsageError for several."""
        return parsing.one_agent(self.agent, self.planner)


@dataclass(frozen=True)
class PluginsGroup:
    """The user's own plugins, and nothing else."""

    agent: opt.OwnAgents = None
    planner: opt.Planners = None

    def named(self) -> list[str]:
        """UsageError for what is no plugin of hers."""
        return parsing.named_plugins(self.agent, self.planner)


@dataclass(frozen=True)
class RecordingGroup:
    """What an evaluation keeps of its episodes."""

    record: opt.Record = 0
    depth_images: opt.DepthImages = False
    explain: opt.Explain = False
    explain_record: opt.ExplainRecord = None

    def asked(self) -> dict[str, Any]:
        """Fields of a ``Request``. UsageError for what does not go together."""
        parsing.refuse_less("--record", self.record, 0)
        if self.explain_record is not None:
            parsing.refuse_less("--explain-record", self.explain_record, 0)
            if not self.explain:
                raise UsageError("--explain-record: give --explain too, it says which episodes to record")
        kept = {each.name: getattr(self, each.name) for each in fields(self)}
        return kept | {"explain_record": 3 if self.explain_record is None else self.explain_record}


@dataclass(frozen=True)
class WorkplaceGroup:
    """Who works on a sweep."""

    engine: opt.EngineName = "local"
    workers: opt.Workers = 1
    address: opt.Address = "auto"

    def made(self) -> Engine:
        """Who works. UsageError."""
        from uuvtai.evaluation.sweep import engine_of

        parsing.refuse_less("--workers", self.workers, 1)
        return engine_of(self.engine, self.workers, self.address)


@dataclass(frozen=True)
class MotionGroup:
    """How a vehicle begins in open water, and what acts on it."""

    seconds: opt.SimulateSeconds
    wrench: opt.Wrench = None
    command: opt.Command = None
    current: opt.Current = None
    initial_rpy_deg: opt.InitialRpy = None
    initial_velocity: opt.InitialVelocity = None
    neutral: opt.Neutral = False
    dt: opt.Substep = 0.01

    def trial(self) -> Trial:
        """UsageError for what is no number."""
        from uuvtai.evaluation.simulate import Trial

        return Trial(
            self.seconds,
            wrench=parsing.numbers("--wrench", self.wrench, 6),
            command=parsing.numbers("--command", self.command, 4),
            current=parsing.numbers("--current", self.current, 3),
            initial_rpy_deg=parsing.numbers("--initial-rpy-deg", self.initial_rpy_deg, 3),
            initial_velocity=parsing.numbers("--initial-velocity", self.initial_velocity, 6),
            neutral=self.neutral,
            dt=self.dt,
        )


@dataclass(frozen=True)
class CompileGroup:
    """What is compiled in advance."""

    compile: opt.Compile = False
    num_envs: opt.BatchSizes = "1,8,64,256"
    world: opt.World = "pool"
    sensors: opt.WarmSensors = "nominal,paper"
    overrides: opt.Set = None
    workers: opt.WarmWorkers = 0

    def made(self) -> list[dict[str, Any]]:
        """Compile; an entry per size and sensors. UsageError, ConfigError."""
        from uuvtai.envs import warm_up

        sizes = parsing.integers("--num-envs", self.num_envs)
        parsing.refuse_less("--workers", self.workers, 0)
        scenes = [
            SceneOptions(self.world, name, overrides=self.overrides) for name in self.sensors.split(",")
        ]
        shapes = warm_up.shapes_of(scenes, sizes)
        say(f"sizes to compile: {len(shapes)}, about a minute each the first time")
        return warm_up.warm(shapes, self.workers or None)


@dataclass(frozen=True)
class FaultsGroup:
    """What happens to the messages of the sensors."""

    drop: opt.Drop = 0.0
    jitter: opt.Jitter = 0.0
    lose: opt.Lose = None
    fault_seed: opt.FaultSeed = 0

    def made(self) -> Faults:
        """UsageError."""
        from uuvtai.vehicle.replay import Faults, outage_of

        parsing.refuse_less("--fault-seed", self.fault_seed, 0, 2**31 - 1)
        return Faults(self.drop, self.jitter, tuple(map(outage_of, self.lose or [])), self.fault_seed)


@dataclass(frozen=True)
class SeenSceneGroup(SceneOptions):
    """What a pilot on a vehicle is told of its world, vehicle and sensors."""

    world: opt.World = "pool"
    sensors: opt.SeenSensors = "multibeam"
    vehicle: opt.Vehicle = None
    overrides: opt.Set = None


@dataclass(frozen=True)
class SitlSceneGroup(SceneOptions):
    """What ArduSub meets."""

    world: opt.World = "pool"
    sensors: opt.SeenSensors = "multibeam"
    vehicle: opt.BaseVehicle = "bluerov2_16v"
    n_static: opt.Static = None
    n_dynamic: opt.Dynamic = None
    speed_m_s: opt.Speed = None
    overrides: opt.Set = None


@dataclass(frozen=True)
class FlightGroup:
    """Where the vehicle is, where it is to go, and what it must keep to."""

    mavlink: opt.Mavlink
    start: opt.PilotStart
    goal: opt.PilotGoal
    dvl: opt.DvlPlace = None
    sonar: opt.SonarPlace = None
    arm: opt.Arm = False
    check: opt.PilotCheck = False
    calibrate: opt.PilotCalibrate = None
    heading: opt.Heading = None
    box: opt.FenceBox = None
    depth: opt.FenceDepth = None
    max_speed: opt.MostSpeed = 0.5
    battery: opt.LeastBattery = 13.2
    system: opt.VehicleId = 1
    operator: opt.OperatorId = 255
    sender: opt.HeardSenders = None
    seconds: opt.PilotSeconds = None
    rate: opt.PilotRate = 1.0
    log: opt.PilotLog = None
    force: opt.PilotForce = False

    def plan(self, config: Config) -> FlightPlan:
        """UsageError, LinkError."""
        from uuvtai.vehicle.control_loop import FlightPlan

        parsing.refuse_odd_rate(self.rate)
        if self.check and self.arm:
            raise UsageError("--check: never arms; leave out --arm, and give it once the check is passed")
        if self.calibrate and (self.arm or self.check):
            raise UsageError("--calibrate: you drive; leave out --arm and --check")
        if self.calibrate and (self.calibrate.exists() or not self.calibrate.parent.is_dir()):
            what = "is there already" if self.calibrate.exists() else "its folder is not there"
            raise UsageError(f"--calibrate {self.calibrate}: {what}; give another name")
        if self.log is not None and self.log.exists() and not self.force:
            raise UsageError(f"--log {self.log}: is there already; give another name, or --force")
        return FlightPlan.typed(
            config,
            self.mavlink,
            parsing.numbers("--start", self.start, 3),
            parsing.numbers("--goal", self.goal, 3),
            parsing.numbers("--box", self.box, 4),
            parsing.numbers("--depth", self.depth, 2),
            self.max_speed,
            self.battery,
            arms=self.arm,
            heading_deg=self.heading,
            seconds=self.seconds,
            rate=self.rate,
            log=self.log,
            system=self.system,
            operator=self.operator,
            senders=self.sender or (),
            instruments={"dvl": self.dvl, "sonar": self.sonar},
            purpose="check" if self.check else "calibrate" if self.calibrate else "fly",
        )


@dataclass(frozen=True)
class ServedGroup:
    """How water is served to ArduSub."""

    seed: opt.SitlSeed = 0
    episode: opt.SitlEpisode = 0
    instances: opt.Instances = 1
    port: opt.SitlPort = 9002
    host: opt.SitlHost = "127.0.0.1"
    mavlink: opt.SensorPlaces = None
    emulated: opt.Emulated = None
    operator: opt.PlayOperator = False
    rate: opt.SitlRate = 0.0
    seconds: opt.SitlSeconds = None
    once: opt.SitlOnce = False

    def plan(self) -> SitlPlan:
        """UsageError, LinkError."""
        from uuvtai.vehicle.sitl import SitlPlan

        parsing.refuse_odd_rate(self.rate)
        return SitlPlan.typed(**vars(self))


@dataclass(frozen=True)
class OutputGroup:
    """How the result is shown."""

    wide: opt.Wide = False
    as_json: opt.AsJson = False
    more = "--wide"

    def show(self, document: Any, shown: Callable[[Screen], None], folder: Path | None = None) -> None:
        """The result, for a program or for a person, who also hears of the run's ``folder``."""
        if self.as_json:
            typer.echo(json.dumps(document, allow_nan=False))
            return
        shown(Screen(self.wide, more=self.more))
        if folder is not None:
            say(f"run folder: {folder}")


@dataclass(frozen=True)
class PlainOutputGroup(OutputGroup):
    """Of what fits most terminals: without ``--wide``."""

    wide: bool = False
    more = "a wider terminal"


# ---- The help of ``uuv`` itself: one line a command.

_GROUPS = {
    "Run": ("demo", "eval", "sweep", "watch", "drive"),
    "Learn": ("train", "export"),
    "Look": ("report", "log", "presets", "doctor", "examples"),
    "Paper": ("reproduce", "profile"),
    "Vehicle": ("pilot", "sitl", "identify", "replay", "simulate"),
}


class Commands(typer.core.TyperGroup):
    """All commands, in groups."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """As ``uuv -h`` prints it."""
        lines = ["Usage: uuv COMMAND [OPTIONS]    (uuv COMMAND -h: its options)", "", self.help or "", ""]
        for title, names in _GROUPS.items():
            for name in names:
                head = typer.style(f"{title if name == names[0] else '':9}", bold=True)
                lines.append(f"{head}{name:11}{self.commands[name].get_short_help_str(60)}")
        lines += ["", "Options: -h, --version, --install-completion, --show-completion", self.epilog or ""]
        formatter.write("\n".join(lines) + "\n")
