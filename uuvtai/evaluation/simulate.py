"""One vehicle: open-loop physics in endless water (``uuv simulate``), live episodes (``uuv watch``), and
driving by hand (``uuv drive``)."""

from __future__ import annotations

import itertools
import math
import webbrowser
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from uuvtai.common.enums import RUNNING
from uuvtai.common.errors import DivergenceError, SettingError
from uuvtai.common.presets import PRESET_DIR, TRAINING_TREE
from uuvtai.compile.runtime import Runtime, start_taichi
from uuvtai.config import Config
from uuvtai.config.loader import ConfigError
from uuvtai.evaluation.agents import AgentSpec, load_agents
from uuvtai.evaluation.episodes import (
    EpisodeObserver,
    Job,
    Recorders,
    Stepper,
    beginning,
    episodes_in_steps,
    run_in_turn,
)
from uuvtai.evaluation.evaluate import Comparison, EvaluationWatch, Guest, agents_of, compare, comparison_of
from uuvtai.evaluation.results import ORACLE, Request
from uuvtai.live.page import PageServer
from uuvtai.live.server import Broadcast, RealTime, ViewerServer
from uuvtai.logs.topics.motion import angles_of, quaternion_of
from uuvtai.plugins.adapters import CallMeter, Marks, OwnCode, PluginAgent
from uuvtai.plugins.api import CONTROLLER, PluginSpec
from uuvtai.plugins.loading import LoadedPlugin
from uuvtai.report.build import report
from uuvtai.report.evaluation import who_arrived
from uuvtai.report.html import live_page
from uuvtai.report.running import RunningEpisodes
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.plant import Plant
from uuvtai.sim.sim import Sim
from uuvtai.state.vehicle import VehicleState

CONTROL_DT_S = 0.02  # Samples are this far apart, or one substep where that is longer.

_MAX_STEPS = 10_000_000
_MAX_COMPONENT = 1e6
_WHAT = {
    "wrench": ("fx,fy,fz,mx,my,mz in N and N m", 6),
    "command": ("surge,sway,heave,yaw rate in m/s and rad/s", 4),
    "current": ("x,y,z in m/s", 3),
    "initial_rpy_deg": ("roll,pitch,yaw in degrees", 3),
    "initial_velocity": ("u,v,w,p,q,r in m/s and rad/s", 6),
}


@dataclass(frozen=True)
class Trial:
    """What one vehicle that starts at the origin is exposed to; None = nothing, rest, level."""

    seconds: float
    wrench: Sequence[float] | None = None
    """constant force and moment [N, N m], body frame, on top of the thrusters, which are off without
    ``command``"""
    command: Sequence[float] | None = None
    """velocity and yaw rate [m/s, rad/s], body frame, for the inner loop"""
    current: Sequence[float] | None = None
    """[m/s], world frame"""
    initial_rpy_deg: Sequence[float] | None = None
    initial_velocity: Sequence[float] | None = None
    """u,v,w,p,q,r [m/s, rad/s], body frame"""
    neutral: bool = False
    """buoyancy equal to weight"""
    dt: float = 0.01
    """substep [s]"""


def simulate(config: Config, trial: Trial, runtime: Runtime | None = None) -> dict[str, list]:
    """Trajectory sampled at every control step, the initial state first: {"t" [s], "position" [m], "rpy_deg",
    "nu" [m/s, rad/s], "rpm"}.

    Starts Taichi in double precision unless ``runtime`` says what is running. Raises SettingError for input
    that makes no sense, DivergenceError where the integration diverges.
    """
    given = {name: getattr(trial, name) for name in _WHAT}
    vectors = {name: checked_vector(name, value) for name, value in given.items() if value is not None}
    substeps, control_dt = control_step(trial.dt)
    n_step = checked_steps(trial.seconds, control_dt, substeps)
    config = experiment(config, trial)
    action = None if trial.command is None else _action(config, vectors["command"])
    plant = Plant(config, runtime or start_taichi(precision="f64"))
    plant.reset()
    _set_start(plant, vectors)
    samples = [_sample(plant.vehicle, plant.read, 0.0)]
    for k in range(1, n_step + 1):
        plant.step(action)
        samples.append(_sample(plant.vehicle, plant.read, k * control_dt))
        if not math.isfinite(sum(samples[-1]["nu"])):
            raise DivergenceError(
                f"the integration diverged at t = {k * control_dt:.2f} s: use a smaller substep, --dt "
                f"{trial.dt / 4:g}"
            )
    return {key: [s[key] for s in samples] for key in samples[0]}


# ------------------------------------------------------------------------------------------------------ input


def checked_vector(name: str, value: Sequence[float]) -> np.ndarray:
    """``value`` as float64; SettingError unless it has the right number of finite, sane components."""
    what, length = _WHAT[name]
    flag = "--" + name.replace("_", "-")
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise SettingError(f"{flag} must be {length} numbers ({what}), got {value!r}") from None
    example = ",".join(["0.1"] + ["0"] * (length - 1))
    if vector.shape != (length,):
        raise SettingError(
            f"{flag} must be {length} numbers ({what}), got {vector.size}: for example {flag} {example}"
        )
    if not np.isfinite(vector).all() or np.abs(vector).max() > _MAX_COMPONENT:
        raise SettingError(
            f"{flag} must be finite numbers below {_MAX_COMPONENT:g} ({what}), got {value!r}: for example "
            f"{flag} {example}"
        )
    return vector


def control_step(dt: float) -> tuple[int, float]:
    """(substeps, control step [s]) for a substep of ``dt``: 0.02 s where dt divides it, else the next
    multiple of dt."""
    if not (isinstance(dt, (int, float)) and math.isfinite(dt) and dt > 0):
        raise SettingError(f"--dt must be a positive number of seconds, got {dt!r}: for example --dt 0.01")
    ratio = CONTROL_DT_S / dt
    substeps = max(1, math.ceil(ratio - 1e-9))
    if abs(ratio - substeps) < 1e-6:
        return substeps, CONTROL_DT_S
    return substeps, substeps * dt


def checked_steps(seconds: float, control_dt: float, substeps: int) -> int:
    """Control steps that cover ``seconds``; SettingError where that is nothing or far too many."""
    if not (isinstance(seconds, (int, float)) and math.isfinite(seconds) and seconds > 0):
        raise SettingError(f"--seconds must be a positive number, got {seconds!r}: for example --seconds 10")
    if seconds / control_dt * substeps > _MAX_STEPS:
        raise SettingError(
            f"--seconds {seconds:g} at --dt {control_dt / substeps:g} is more than {_MAX_STEPS} substeps: "
            "use fewer seconds or larger --dt"
        )
    return max(1, math.ceil(seconds / control_dt - 1e-6))


def _action(config: Config, command: np.ndarray) -> np.ndarray:
    vehicle = config.vehicle
    names = ("max_surge_m_s", "max_sway_m_s", "max_heave_m_s", "max_yaw_rate_rad_s")
    limits = np.array([getattr(vehicle, name) for name in names])
    for name, value, limit in zip(names, command, limits, strict=True):
        if abs(value) > limit * (1 + 1e-9):
            raise SettingError(
                f"--command asks for {value:g}, above vehicle.{name} = {limit:g}: ask for less, or --set "
                f"vehicle.{name}={abs(value):g}"
            )
    return (command / limits).astype(np.float32)[None, :]


def experiment(config: Config, trial: Trial) -> Config:
    """The config with the trial's current, buoyancy and steps in it. Raises SettingError."""
    substeps, control_dt = control_step(trial.dt)
    vehicle, disturbance = config.vehicle, config.disturbance
    if trial.neutral:
        vehicle = vehicle.model_copy(update={"volume_m3": vehicle.mass_kg / vehicle.water_density_kg_m3})
    if trial.current is not None:
        current = checked_vector("current", trial.current)
        disturbance = disturbance.model_copy(update={"current_m_s": tuple(float(x) for x in current)})
    episode = config.episode.model_copy(update={"control_dt_s": control_dt, "substeps": substeps})
    return config.model_copy(update={"vehicle": vehicle, "disturbance": disturbance, "episode": episode})


# ------------------------------------------------------------------------------------------------- trajectory


def _set_start(plant: Plant, vectors: dict[str, np.ndarray]) -> None:
    if "initial_rpy_deg" in vectors:
        plant.write(plant.vehicle.quat_wb, quaternion_of(np.radians(vectors["initial_rpy_deg"])))
    if "initial_velocity" in vectors:
        plant.write(plant.vehicle.vel_b, vectors["initial_velocity"][:3])
        plant.write(plant.vehicle.rate_b, vectors["initial_velocity"][3:])
    if "wrench" in vectors:
        plant.write(plant.actuation.external_wrench_b, vectors["wrench"])


def _sample(
    v: VehicleState, read: Callable[[Any], np.ndarray], time_s: float, start: np.ndarray | float = 0.0
) -> dict[str, Any]:
    """Of row 0; ``start`` (3,) [m]: where positions count from."""
    position, q, vel, rate, rpm = (
        read(field)[0].astype(float) for field in (v.pos_w, v.quat_wb, v.vel_b, v.rate_b, v.rpm)
    )
    return {
        "t": time_s,
        "position": (position - start).tolist(),
        "rpy_deg": np.degrees(angles_of(*q)).tolist(),
        "nu": [*vel.tolist(), *rate.tolist()],
        "rpm": rpm.tolist(),
    }


# ---- One vehicle that an agent drives through open water, from a start to a goal: ``uuv simulate --agent``.

_NOT_BESIDE = ("wrench", "command", "initial_rpy_deg", "initial_velocity")


def drive(config: Config, trial: Trial, name: str) -> dict[str, list]:
    """As ``simulate.simulate``, positions [m] from the start, with "goal" [m] from there. It ends early where
    the goal is reached or the tank is left. ``name``: any agent. Raises SettingError,
    ConfigError, PluginError."""
    for given in _NOT_BESIDE:
        if getattr(trial, given) is not None:
            option = "--" + given.replace("_", "-")
            raise SettingError(f"{option}: not beside --agent, which drives from rest; leave one of them out")
    substeps, control_dt = control_step(trial.dt)
    n_step = checked_steps(trial.seconds, control_dt, substeps)
    (agent,) = load_agents([name])
    config = agent.config_of(experiment(config, trial))
    config = config.model_copy(
        update={"episode": config.episode.model_copy(update={"horizon_steps": n_step + 1})}
    )
    sim = Sim(config, 1, agent.tree, "cpu")
    sim.planner, sim.privileged = agent.planner_for(sim), agent.privileged
    note = agent.agent_for(sim)
    stepper = Stepper(sim, note.agent if note else None)
    stepper.reset(*beginning(sim, {0: Job(0, 0)}))
    start, goal = (sim.rows(field)[0].astype(float) for field in (sim.s.vehicle.pos_w, sim.s.mission.goal_w))
    samples = [_sample(sim.s.vehicle, sim.rows, 0.0, start)]
    for k in range(1, n_step + 1):
        stepper.step()
        samples.append(_sample(sim.s.vehicle, sim.rows, k * control_dt, start))
        if sim.rows(sim.s.termination.outcome)[0] != RUNNING:
            break
    if agent.own:
        agent.own.close()
    return {key: [s[key] for s in samples] for key in samples[0]} | {"goal": (goal - start).tolist()}


# ---- ``uuv watch``: episodes at the clock's pace, for pages or Foxglove; ``uuv drive``: one in which a
# person drives.

LAYOUT = PRESET_DIR / "layout" / "navigation.json"  # for Foxglove and Lichtblick
PERSON = "human"  # who drives by hand, in tables and files


@dataclass(frozen=True)
class LiveOptions:
    """How episodes are shown."""

    host: str = "127.0.0.1"
    port: int = 8765
    rate: float = 1.0
    """seconds of the episode in one of the clock's; 0 = as fast as it goes"""
    origins: Sequence[str] = ()
    """of web pages that may connect beside those of this host; of our page, addresses that lead to it"""
    tanks: int = 1
    """episodes at once"""
    foxglove: bool = False
    """in place of our page"""
    opens: bool = False
    """in the browser, by itself"""


def watch_episodes(request: Request, live: LiveOptions, watch: EvaluationWatch) -> list[dict[str, Any]]:
    """Run the request's episodes, ``live.tanks`` at once, and serve them: by all agents side by side, in
    Foxglove by one after the other; ``episodes`` 0 = on and on, until it is interrupted. How each ended.
    Raises LiveError, ConfigError, CheckpointError, PluginError."""
    if ORACLE in request.agents:
        raise ConfigError("--agent oracle: it drives no vehicle; name who does, for example bt")
    agents = agents_of(request, watch)
    if live.foxglove:
        server = ViewerServer(live.host, live.port, live.origins)
        watch.note(f"serving {server.url}; in Foxglove or Lichtblick: open a connection,")
        watch.note(f"Foxglove WebSocket, to that address, and import the layout {LAYOUT}")
    else:
        server = _page_of(request, [agent.name for agent in agents], live, watch)
    with server:
        alone = [comparison_of(request, live.tanks, [agent], watch) for agent in agents]
        groups = [[one] for one in alone] if live.foxglove else [alone]
        try:
            return [
                entry
                for jobs in _batches(request, live.tanks)
                for group in groups
                for entry in _watched(group, jobs, server, live.rate)
            ]
        finally:
            for agent in agents:
                if agent.own:
                    agent.own.close()


def _page_of(
    request: Request, names: list[str], live: LiveOptions, watch: EvaluationWatch, steered: bool = False
) -> PageServer:
    """The page's server, told of and opened."""
    world = Path(request.world).stem
    title = f"{', '.join(names)} in {world}"
    page = live_page(title, "drive to the star" if steered else "live")
    server = PageServer(page, live.host, live.port, live.origins, steered)
    watch.note(f"open {server.url} in a browser" + ("" if steered else "; Ctrl-C ends it"))
    server.note("The simulator starts.")
    if live.opens and not webbrowser.open_new_tab(server.url):
        watch.note(f"--open: no browser was found here; open {server.url} in one")
    return server


def _batches(request: Request, size: int) -> Iterable[list[Job]]:
    numbers = range(request.episodes) if request.episodes else itertools.count()
    jobs = (Job(seed, number) for number in numbers for seed in request.seeds)
    while batch := [*itertools.islice(jobs, size)]:
        yield batch


def _watched(
    side_by_side: list[Comparison], jobs: list[Job], server: ViewerServer | PageServer, rate: float
) -> list[dict[str, Any]]:
    """Run episodes for all to see, by the one agent of each comparison; how they ended."""
    request, watch = side_by_side[0].request, side_by_side[0].watch
    agents, world = [one.agents[0] for one in side_by_side], Path(request.world).stem
    clocks = [RealTime(request.config.episode.control_dt_s, rate) for _ in agents]
    policies = [one.policies[agent.name] for one, agent in zip(side_by_side, agents, strict=True)]
    shown: list[EpisodeObserver]
    if isinstance(server, ViewerServer):
        shown = [Broadcast(server, world, agents[0].name, request.depth_images, policies[0])]
    else:
        first = RunningEpisodes(server, world, [agent.name for agent in agents], rate)
        shown = [*first.side_by_side()]
    going = [
        episodes_in_steps(
            one.simulator_for(agent), jobs, Recorders([see, clock]), agent=policy.agent if policy else None
        )
        for one, agent, see, clock, policy in zip(side_by_side, agents, shown, clocks, policies, strict=True)
    ]
    entries = []
    for agent, (results, _), clock in zip(agents, run_in_turn(going), clocks, strict=True):
        for result in results:
            entry = {
                "agent": agent.name,
                **{name: getattr(result, name) for name in ("seed", "episode", "outcome", "time_s")},
                "min_clearance_m": round(result.min_clearance_m, 4),
                "real_time_factor": round(clock.real_time_factor, 2),
            }
            entries.append(entry)
            watch.note(
                f"{agent.name}, seed {entry['seed']}, episode {entry['episode']}: {entry['outcome']} after "
                f"{entry['time_s']:.1f} s ({entry['real_time_factor']:.2f} of real time)"
            )
    return entries


class _Hand(LoadedPlugin):
    """A person who steers by the page, as a plugin that is asked for actions."""

    def agent(self, sim: Sim) -> PluginAgent:
        """Drives all rows by the newest command."""
        meter = CallMeter(PERSON, Path(), math.inf, self.note)
        code = OwnCode(self.spec, self.found.command, None, "", Marks(), meter)
        return PluginAgent(sim, code, lambda rows, obs: torch.tensor([self.found.command()] * len(rows)))

    def saw_truth(self) -> bool:
        """Whether the page has shown what no vehicle senses."""
        return self.found.truth_was_seen

    def document(self) -> dict[str, Any]:
        """A person has no file."""
        return {}


def drive_by_hand(
    request: Request, live: LiveOptions, watch: EvaluationWatch
) -> tuple[dict[str, Any], Path, Path]:
    """A person drives the request's episodes, one after the other, on a page; then its agents do. The ``uuv
    eval --json`` document, the run folder, and its report. Raises as ``watch_episodes`` and ``compare``."""
    if request.num_envs is None:
        request = replace(request, num_envs=1)
    request = replace(request, record=len(request.seeds) * request.episodes)
    with _page_of(request, [PERSON, *request.agents], live, watch, steered=True) as server:
        own = _Hand(PluginSpec(CONTROLLER, Path(PERSON)), "", server, watch.note)
        dt_s = request.config.episode.control_dt_s
        shown = RunningEpisodes(server, Path(request.world).stem, [PERSON], live.rate)
        observer = Recorders([shown, RealTime(dt_s, live.rate)])
        hand = AgentSpec(PERSON, read_tree(TRAINING_TREE), own=own)
        result, folder = compare(request, watch, Guest(hand, observer))
        page = report([folder]).page
        server.note(f"{who_arrived(result['agents'])} Report: {page}")
    if live.opens:
        webbrowser.open_new_tab(page.resolve().as_uri())
    return result, folder, page
