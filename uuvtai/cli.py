"""The command line ``uuv``: parse, load the preset, call one function, print.

Results go to stdout, progress and messages to stderr. Exit codes: 0 ok, 1 runtime failure, 2 usage or config, 3 a gate was not met,
130 interrupted. Heavy packages are imported inside the commands, so that ``uuv --help`` is quick.
"""

from __future__ import annotations

import gc
import json
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from uuvtai import __version__

OK, FAILED, USAGE, GATE, INTERRUPTED = 0, 1, 2, 3, 130

UsageError: Any = typer.BadParameter.__base__
"""Typer carries its own copy of click from 0.26 on, so the class is taken from what Typer exports."""

app = typer.Typer(
    name="uuv",
    help="Train, measure and inspect observation-only navigation for underwater vehicles.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
log_app = typer.Typer(help="Look into recorded episodes (MCAP).", no_args_is_help=True)
app.add_typer(log_app, name="log")

World = Annotated[str, typer.Option("--world", help="World preset or path of a YAML file.")]
Sensors = Annotated[str | None, typer.Option("--sensors", help="Sensor preset or path \\[default: the world's own, else paper].")]
Vehicle = Annotated[str | None, typer.Option("--vehicle", help="Vehicle preset or path.")]
Static = Annotated[int | None, typer.Option("-S", help="Static obstacles.")]
Dynamic = Annotated[int | None, typer.Option("-D", help="Moving obstacles.")]
Speed = Annotated[float | None, typer.Option("-v", help="Speed of the moving obstacles \\[m/s].")]
Set = Annotated[list[str] | None, typer.Option("--set", help="Override a config key: key.sub=value (repeatable).")]
Device = Annotated[str, typer.Option("--device", help="auto, cpu or cuda.")]
RunDir = Annotated[Path | None, typer.Option("--run-dir", help="The run's folder \\[default: runs/<time>_<preset>].")]
WithReport = Annotated[bool, typer.Option("--report", help="Also write the run's report.html.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else on stdout.")]


# -------------------------------------------------------------------------------------------------------------------- eval


@app.command("eval")
def evaluate(
    runs: Annotated[
        list[str] | None,
        typer.Argument(metavar="[RUN]...", help="Trained policies: run folders, checkpoint folders or shipped names (best)."),
    ] = None,
    controller: Annotated[
        list[str] | None,
        typer.Option(
            "--controller",
            help="straight, planner, bt or a tree's XML (repeatable); none = policies alone \\[default: all three, beside a RUN bt]. "
            "Privileged yardsticks: NAME+truth (a tree that knows where every moving body is), oracle (knows the future: an upper bound).",
        ),
    ] = None,
    world: World = "pool",
    sensors: Sensors = None,
    vehicle: Vehicle = None,
    episodes: Annotated[int, typer.Option("--episodes", help="Episodes per seed.")] = 64,
    seeds: Annotated[str, typer.Option("--seeds", "--seed", help="Seeds, separated by commas.")] = "0",
    n_static: Static = None,
    n_dynamic: Dynamic = None,
    speed: Speed = None,
    num_envs: Annotated[int | None, typer.Option("--num-envs", help="Episodes played together \\[default: as many as sensible].")] = None,
    record: Annotated[int, typer.Option("--record", help="Record the first K episodes of every method as MCAP with a picture.")] = 0,
    video: Annotated[bool, typer.Option("--video", help="Also a top-down video of every recorded episode.")] = False,
    depth_images: Annotated[bool, typer.Option("--depth-images", help="Also record the depth camera (2 Hz).")] = False,
    explain: Annotated[
        bool, typer.Option("--explain", help="Label the cause of every failure, judged from the truth: which sense or decision failed.")
    ] = False,
    explain_record: Annotated[
        int | None,
        typer.Option("--explain-record", help="With --explain: log, picture, video of N of the worst failures per method \\[default: 3]."),
    ] = None,
    device: Device = "auto",
    overrides: Set = None,
    with_report: WithReport = False,
    run_dir: RunDir = None,
    as_json: AsJson = False,
) -> None:
    """Play the same episodes with every controller and trained policy and print the table of methods."""
    seed_list = _seeds(seeds)
    _at_least("--episodes", episodes, 1)
    _at_least("--record", record, 0)
    if explain_record is not None:
        _at_least("--explain-record", explain_record, 0)
        if not explain:
            raise UsageError("--explain-record: give --explain too, it says which episodes to record")
    policies = runs or []
    config = _config(world, sensors, vehicle, n_static, n_dynamic, speed, overrides, _policy_features(policies))

    from uuvtai.loader import sensors_of
    from uuvtai.measure.compare import Request, compare

    request = Request(
        config=config,
        world=world,
        sensors=sensors_of(world, sensors),
        controllers=_controllers(controller, bool(policies)),
        policies=tuple(policies),
        seeds=seed_list,
        episodes=episodes,
        num_envs=num_envs,
        record=record,
        video=video,
        depth_images=depth_images,
        explain=explain,
        explain_record=3 if explain_record is None else explain_record,
        device=device,
        run_dir=run_dir,
    )
    result, folder = compare(request, _Progress())
    _print_evaluation(result, folder, as_json)
    if with_report:
        _say(f"report: {_write_report([folder], None).page}")


def _controllers(given: list[str] | None, has_policies: bool) -> list[str]:
    """Names typed with --controller; without any all three, or the tree alone beside a policy."""
    default = ["bt"] if has_policies else ["straight", "planner", "bt"]
    names = [name for item in given or default for name in item.split(",") if name]
    if has_policies and names == ["none"]:
        return []
    if not names:
        raise UsageError("--controller: name at least one of straight, planner, bt or a tree's XML")
    return names


def _policy_features(policies: list[str]) -> list[tuple[str, Any]]:
    """Settings of the observation that the policies were trained with."""
    if not policies:
        return []
    from uuvtai.measure.methods import features_of

    return features_of(policies)


def _print_evaluation(result: dict[str, Any], folder: Path, as_json: bool) -> None:
    if as_json:
        _print_json(result)
        return
    _print_methods(result)
    for method in result["methods"]:
        if "risk" in method:
            _print_risk(method["name"], method["risk"])
    if any("causes" in method for method in result["methods"]):
        _print_causes(result)
        _say(f"facts of every failure, and which of them are recorded: {folder / 'eval/explain.json'}")
    _say(f"run folder: {folder}")


def _print_methods(result: dict[str, Any]) -> None:
    speed = f"v = {result['v_m_s']} m/s, " if result["D"] else ""
    table = Table(
        title=f"{result['world']}: S = {result['S']}, D = {result['D']}, {speed}{result['sensors']} sensing, "
        f"{len(result['seeds'])} {'seed' if len(result['seeds']) == 1 else 'seeds'} x {result['episodes_per_seed']} episodes",
        title_justify="left",
    )
    for head in (
        "method",
        "success [95 %]",
        "collision [95 %]",
        "contact/ttc/out/timeout",
        "time to goal s",
        "TTS s",
        "replans",
        "steps/s",
    ):
        table.add_column(head, justify="left" if head == "method" else "right")
    for m in result["methods"]:
        o = m["outcomes"]
        collided = o["collision"] + o["ttc"] + o["out_of_tank"]
        table.add_row(
            f"{m['name']} {_DAGGER}" if m["privileged"] else m["name"],
            _rate(o["success"], m["episodes"], m["success_ci95"]),
            _rate(collided, m["episodes"], m["collision_ci95"]),
            f"{o['collision']}/{o['ttc']}/{o['out_of_tank']}/{o['timeout']}",
            _number(m["time_to_success_mean_s"]),
            _number(m["tts_s"]),
            _number(m["replans_per_episode"]),
            "-" if m["env_steps_per_s"] is None else f"{m['env_steps_per_s']:,.0f}",
        )
    _stdout().print(table)
    _print_condition(result["condition"])
    for part in result["remainder"]:
        _print_remainder(part)
    for m in result["methods"]:
        if m["privileged"]:
            _stdout().print(f"[dim]{_DAGGER} {m['name']} is privileged: {_privilege(m['name'])}[/dim]", highlight=False)


def _print_remainder(part: dict[str, Any]) -> None:
    _stdout().print(
        f"{part['method']} misses {part['missed']} of {part['episodes']}: {part['sensing']} by sensing (told of the moving bodies it "
        f"arrives), {part['forecast_decision']} by forecast, decision and inertia (a point had a way), {part['physics']} by physics "
        "(the oracle finds none)",
        highlight=False,
    )


_DAGGER = "\u2020"


def _privilege(name: str) -> str:
    if name == "oracle":
        return "it knows the future and has no inertia; timeout = not reachable. An upper bound, no controller"
    return "it is told where every moving body is and how it moves; what stands still it senses"


def _print_condition(condition: dict[str, Any]) -> None:
    """How hard the condition is, in one line."""
    detection, rides = condition["detection"], _rate(condition["rides_threatened"], condition["rides"], condition["rides_threatened_ci95"])
    if detection is None:
        return
    _stdout().print(
        f"threat rate {condition['threats_per_min']:.2f} per minute ({condition['threats']} moving bodies in "
        f"{condition['ride_minutes']:.1f} min of blind rides; {rides} of the rides meet one), required detection distance "
        f"{detection['required_m']:.1f} m (closing {detection['closing_m_s']:.1f} m/s, {detection['aside_s']:.1f} s to move aside)",
        highlight=False,
    )


def _print_risk(name: str, risk: dict[str, Any]) -> None:
    """How far the policy's probability of an accident soon can be believed."""
    _stdout().print(
        f"{name}: risk of an accident soon at {risk['moments']:,} moments: Brier {risk['brier']:.4f} "
        f"(base rate {risk['brier_base_rate']:.4f}), ECE {risk['ece']:.4f}, AUROC {risk['auroc']:.3f}",
        highlight=False,
    )
    bins = risk["reliability"]
    pairs = zip(bins["predicted"], bins["observed"], bins["samples"], strict=True)
    _stdout().print("  said -> came (n): " + ", ".join(f"{p:.2f} -> {o:.2f} ({n:,.0f})" for p, o, n in pairs), highlight=False)
    if "accidents" in risk:
        low, high = risk["missed_ci95"]
        _stdout().print(
            f"  alarm: missed {risk['missed']} of {risk['accidents']} accidents, {100 * low:.1f} to {100 * high:.1f} % "
            f"(promised {100 * risk['promised_miss_rate']:g} %), raised in {100 * risk['alarm_rate_safe']:.1f} % of the safe moments",
            highlight=False,
        )


def _print_causes(result: dict[str, Any]) -> None:
    for m in result["methods"]:
        failed = len(m["explain"])
        if not failed:
            _stdout().print(f"{m['name']}: no episode failed, nothing to explain", highlight=False)
            continue
        title = f"{m['name']}: why {failed} of {m['episodes']} episodes failed"
        table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
        for head in ("cause", "n", "share", "knew", "unseen", "evading", "chance", "worst"):
            table.add_column(head, justify="left" if head in ("cause", "worst") else "right", no_wrap=True)
        for c in m["causes"]:
            medians = (c["unseen_median_s"], c["evading_median_s"], c["last_chance_median_s"])
            worst = ":".join(map(str, c["examples"][0]))
            table.add_row(c["label"], str(c["count"]), _percent(c["share"]), _percent(c["knew_share"]), *map(_seconds, medians), worst)
        _stdout().print(table)
        for c in m["causes"]:
            remarks = ", ".join(f"{k} {remark}" for remark, k in c["remarks"].items() if k >= _REMARKABLE_SHARE * c["count"])
            _stdout().print(f"[bold]{c['label']}[/bold]: {c['meaning']}{f' [dim]({remarks})[/dim]' if remarks else ''}", highlight=False)
    if any(m["explain"] for m in result["methods"]):
        _stdout().print(f"[dim]{_CAUSES_LEGEND}[/dim]", highlight=False)


_REMARKABLE_SHARE = 0.2
"""Remarks on fewer of a cause's episodes are left to the JSON."""

_CAUSES_LEGEND = (
    "knew: share whose forecast of the killer, made 1 s before the end, was right. Medians before the end: unseen = since a beam last met "
    "the killer, evading = since evasion began, chance = until when some velocity still escaped. worst: seed:episode of the hardest hit"
)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f} %"


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f} s"


def _rate(k: int, n: int, interval: list[float] | None) -> str:
    bounds = f" [{100 * interval[0]:.0f}, {100 * interval[1]:.0f}]" if interval else ""
    return f"{k}/{n} = {100 * k / n:.1f} %{bounds}" if n else "-"


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


# ------------------------------------------------------------------------------------------------------------------- train


@app.command("train")
def train_policy(
    preset: Annotated[str | None, typer.Argument(help="Training preset or path of a YAML file \\[default: best].")] = None,
    resume: Annotated[Path | None, typer.Option("--resume", help="Run folder to go on with, with its own config.")] = None,
    iterations: Annotated[
        int | None,
        typer.Option("--iterations", help="Stop when so many are done in all; schedules run over train.iterations in any case."),
    ] = None,
    num_envs: Annotated[int | None, typer.Option("--num-envs", help="Envs stepped together (train.num_envs).")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of networks, exploration and scenarios (train.seed).")] = None,
    world: Annotated[str | None, typer.Option("--world", help="World preset or path \\[default: the training preset's].")] = None,
    sensors: Annotated[str | None, typer.Option("--sensors", help="Sensor preset or path \\[default: the training preset's].")] = None,
    n_static: Static = None,
    n_dynamic: Dynamic = None,
    speed: Speed = None,
    device: Device = "auto",
    with_report: WithReport = False,
    overrides: Set = None,
    run_dir: RunDir = None,
    as_json: AsJson = False,
) -> None:
    """Train a policy into a run folder, or go on with one. Ctrl-C saves; --resume goes on."""
    from uuvtai.loader import load_training
    from uuvtai.measure.training import TrainRequest, train

    if resume is None:
        sizes = [(f"train.{key}", value) for key, value in (("num_envs", num_envs), ("seed", seed)) if value is not None]
        chosen = preset or "best"
        typed = [*sizes, *_scene_flags(n_static, n_dynamic, speed), *(overrides or [])]
        config = load_training(chosen, typed, world, sensors)
        request = TrainRequest(config=config, preset=chosen, iterations=iterations, device=device, run_dir=run_dir)
    else:
        given = {"PRESET": preset, "--num-envs": num_envs, "--seed": seed, "--world": world, "--sensors": sensors}
        given |= {"-S": n_static, "-D": n_dynamic, "-v": speed, "--run-dir": run_dir}
        _refuse_beside_resume(given)
        request = TrainRequest(resume=resume, overrides=list(overrides or []), iterations=iterations, device=device)
    result, folder = train(request, _Training())
    if with_report:
        _say(f"report: {_write_report([folder], None).page}")
    if as_json:
        _print_json(result)


def _refuse_beside_resume(given: dict[str, Any]) -> None:
    for option, value in given.items():
        if value is not None:
            raise UsageError(f"{option} {value}: a resumed run keeps its own; leave it out, or begin a new run without --resume")


class _Training:
    """Live dashboard on a terminal, one plain line every few seconds otherwise."""

    _PERIOD_S = 5.0

    def __init__(self) -> None:
        self._live = None
        self._last = 0.0
        self._evaluated: dict[str, float] = {}
        """newest figures of an evaluation"""

    def start(self, folder: Path, config: Any, done: int, total: int) -> None:
        """``done`` of ``total`` iterations are over as the run begins in ``folder``."""
        import time

        _say(f"run folder: {folder}")
        self._folder, self._done, self._total, self._begun = folder, done, total, time.perf_counter()
        world = config.world
        self._title = f"{config.train.num_envs} envs, S = {world.n_static}, D = {world.n_dynamic}, v = {world.dynamic_speed_m_s} m/s"
        if sys.stderr.isatty():
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), refresh_per_second=4, transient=False)
            self._live.start()

    def note(self, text: str) -> None:
        """A message for the person who waits."""
        if self._live is not None:
            self._live.console.print(text, highlight=False, markup=False)
        else:
            _say(text)

    def update(self, done: int, metrics: dict[str, float], success_ci95: tuple[float, float] | None) -> None:
        """Iteration ``done`` is over."""
        import time

        now = time.perf_counter()
        eta_s = (now - self._begun) / max(1, done - self._done) * (self._total - done)
        self._evaluated |= {name: value for name, value in metrics.items() if name.startswith("eval/")}
        rows = _training_rows(self._evaluated | metrics, success_ci95, eta_s)
        if self._live is not None:
            table = Table(
                title=f"{self._folder}: iteration {done} of {self._total}, {self._title}", title_justify="left", show_header=False
            )
            for name, text in rows.items():
                table.add_row(name, text)
            self._live.update(table)
        elif now - self._last >= self._PERIOD_S or done == self._total:
            self._last = now
            _say(f"{done}/{self._total}: " + ", ".join(f"{name} {text}" for name, text in rows.items()))

    def stop(self) -> None:
        """The run is over."""
        if self._live is not None:
            self._live.stop()
            self._live = None


def _training_rows(metrics: dict[str, float], success_ci95: tuple[float, float] | None, eta_s: float) -> dict[str, str]:
    """What the dashboard shows: name -> text."""
    of = metrics.get
    interval = f" [{100 * success_ci95[0]:.0f}, {100 * success_ci95[1]:.0f}]" if success_ci95 else ""
    times = {name: of(f"time/{name}_s", 0.0) for name in ("simulate", "infer", "learn")}
    split = " / ".join(f"{name} {100 * spent / max(1e-9, sum(times.values())):.0f} %" for name, spent in times.items())
    rows = {
        "reward": _number(of("rollout/ep_rew_mean"), 2),
        "success": _percent(of("rollout/success_rate")) + interval,
        "collision": _percent(of("rollout/collision_rate")),
        "env-steps/s": f"{of('time/env_steps_per_s', 0.0):,.0f} ({split})",
        "env-steps": f"{of('time/env_steps', 0.0):,.0f}",
        "lambda": _number(of("distill/lambda_risk"), 3),
        "ETA": f"{eta_s:.0f} s",
    }
    if "eval/success_rate" in metrics:
        rows["evaluation"] = f"success {_percent(of('eval/success_rate'))}, collision {_percent(of('eval/collision_rate'))}"
    return rows


# ---------------------------------------------------------------------------------------------------------------- simulate


@app.command()
def simulate(
    seconds: Annotated[float, typer.Option("--seconds", help="Duration \\[s].")],
    vehicle: Annotated[str, typer.Option("--vehicle", help="Vehicle preset or path.")] = "bluerov2",
    attitude_hold: Annotated[str | None, typer.Option("--attitude-hold", help="ideal, thrusters, none \\[default: the vehicle's].")] = None,
    wrench: Annotated[str | None, typer.Option("--wrench", help="Constant body wrench fx,fy,fz,mx,my,mz [N, N m].")] = None,
    command: Annotated[
        str | None, typer.Option("--command", help="Body velocity command u,v,w,r \\[m/s, rad/s] for the inner loop.")
    ] = None,
    current: Annotated[str | None, typer.Option("--current", help="Water velocity x,y,z \\[m/s].")] = None,
    initial_rpy_deg: Annotated[str | None, typer.Option("--initial-rpy-deg", help="Roll, pitch, yaw \\[deg].")] = None,
    initial_velocity: Annotated[str | None, typer.Option("--initial-velocity", help="u,v,w,p,q,r \\[m/s, rad/s].")] = None,
    neutral: Annotated[bool, typer.Option("--neutral", help="Buoyancy equal to weight.")] = False,
    dt: Annotated[float, typer.Option("--dt", help="Dynamics substep \\[s].")] = 0.01,
    overrides: Set = None,
    as_json: AsJson = False,
) -> None:
    """Open-loop physics in open water, to validate a vehicle against theory or data."""
    extra = [f"vehicle.attitude_hold={attitude_hold}"] if attitude_hold else []
    config = _config("open", "clean", vehicle, None, None, None, [*(overrides or []), *extra])

    from uuvtai.measure.simulate import simulate as run

    result = run(
        config,
        wrench=_numbers("--wrench", wrench, 6),
        command=_numbers("--command", command, 4),
        current=_numbers("--current", current, 3),
        initial_rpy_deg=_numbers("--initial-rpy-deg", initial_rpy_deg, 3),
        initial_velocity=_numbers("--initial-velocity", initial_velocity, 6),
        neutral=neutral,
        dt=dt,
        seconds=seconds,
    )
    if as_json:
        _print_json(result)
        return
    table = Table(title=f"{vehicle}: {seconds:g} s, substep {dt:g} s", title_justify="left")
    for head in ("t s", "x m", "y m", "z m", "roll deg", "pitch deg", "yaw deg", "u m/s", "v m/s", "w m/s", "p", "q", "r rad/s"):
        table.add_column(head, justify="right")
    for i in _picked(len(result["t"]), 12):
        values = [result["t"][i], *result["position"][i], *result["rpy_deg"][i], *result["nu"][i]]
        table.add_row(*[f"{value:.3f}" for value in values])
    _stdout().print(table)


def _picked(n: int, wanted: int) -> list[int]:
    return sorted({round(i * (n - 1) / max(1, wanted - 1)) for i in range(wanted)}) if n else []


# ------------------------------------------------------------------------------------------------------------------- sweep


@app.command()
def sweep(
    runs: Annotated[list[str] | None, typer.Argument(metavar="[RUN]...", help="Trained policies, as for eval.")] = None,
    controller: Annotated[
        list[str] | None, typer.Option("--controller", help="straight, planner, bt or a tree's XML (repeatable) \\[default: bt].")
    ] = None,
    grid: Annotated[
        list[str] | None,
        typer.Option(
            "--grid",
            help="AXIS=value,value,.. (repeatable: S, D, v, sensors, vehicle, any config key) or a grid preset \\[default: paper].",
        ),
    ] = None,
    world: World = "pool",
    sensors: Sensors = None,
    vehicle: Vehicle = None,
    n_static: Static = None,
    n_dynamic: Dynamic = None,
    speed: Speed = None,
    episodes: Annotated[int, typer.Option("--episodes", help="Episodes per seed, cell and method.")] = 64,
    seeds: Annotated[str, typer.Option("--seeds", "--seed", help="Seeds, separated by commas.")] = "0",
    num_envs: Annotated[int | None, typer.Option("--num-envs", help="Episodes played together \\[default: as many as sensible].")] = None,
    engine: Annotated[str, typer.Option("--engine", help="local (processes on this machine) or ray (a cluster).")] = "local",
    workers: Annotated[int, typer.Option("--workers", help="Processes of the local engine.")] = 1,
    address: Annotated[str, typer.Option("--address", help="Ray cluster: host:port, auto, or local (inside this process).")] = "auto",
    resume: Annotated[Path | None, typer.Option("--resume", help="Run folder of a sweep to go on with.")] = None,
    device: Device = "auto",
    with_report: WithReport = False,
    overrides: Set = None,
    run_dir: RunDir = None,
    as_json: AsJson = False,
) -> None:
    """Play every cell of a grid with every method; finished cells survive a kill: --resume goes on."""
    from uuvtai.measure.sweep.grid import grid_of
    from uuvtai.measure.sweep.plan import SweepRequest
    from uuvtai.measure.sweep.run import resume as go_on
    from uuvtai.measure.sweep.run import sweep as begin

    _at_least("--episodes", episodes, 1)
    _at_least("--workers", workers, 1)
    if resume is not None:
        given = {"RUN": runs, "--controller": controller, "--grid": grid, "--set": overrides, "--run-dir": run_dir, "--num-envs": num_envs}
        given |= {"--sensors": sensors, "--vehicle": vehicle, "-S": n_static, "-D": n_dynamic, "-v": speed}
        _refuse_beside_resume(given)
        result, folder = go_on(resume, _engine(engine, workers, address), _Progress("cells"))
    else:
        policies = runs or []
        request = SweepRequest(
            grid=grid_of(grid or []),
            world=world,
            sensors=sensors,
            vehicle=vehicle,
            overrides=(*_scene_flags(n_static, n_dynamic, speed), *(overrides or [])),
            controllers=tuple(_controllers(controller or ["bt"], bool(policies))),
            policies=tuple(policies),
            seeds=tuple(_seeds(seeds)),
            episodes=episodes,
            num_envs=num_envs,
            device=device,
        )
        result, folder = begin(request, _engine(engine, workers, address), run_dir, _Progress("cells"))
    if with_report:
        _say(f"report: {_write_report([folder], None).page}")
    if as_json:
        _print_json(result)
        return
    _print_sweep(result)
    _say(f"run folder: {folder}")


def _engine(name: str, workers: int, address: str) -> Any:
    from uuvtai.measure.sweep.engines import LocalEngine, RayEngine

    if name not in ("local", "ray"):
        raise UsageError(f"--engine {name!r}: local or ray")
    return LocalEngine(workers) if name == "local" else RayEngine(address)


def _print_sweep(result: dict[str, Any]) -> None:
    from uuvtai.report.alone import is_alone, told
    from uuvtai.report.heatmap import varying

    if len(varying(result["axes"])) > 1 and not is_alone(result):
        from uuvtai.report.terminal import print_heat_maps

        print_heat_maps(result, _stdout())
        return
    table = Table(title=f"{result['world']}: {len(result['cells'])} cells x {result['episodes_per_seed']} episodes", title_justify="left")
    others = ["changed"] if is_alone(result) else [name for name in result["axes"] if name not in ("S", "D", "v")]
    for head in ("S", "D", "v m/s", *others, "method", "success [95 %]", "collision [95 %]", "time to goal s"):
        table.add_column(head, justify="right")
    for row in result["cells"]:
        o, n = row["outcomes"], row["episodes"]
        table.add_row(
            str(row["S"]),
            str(row["D"]),
            _number(row["v_m_s"]),
            *([told(row, result)] if is_alone(result) else [str(row.get(name, "")) for name in others]),
            row["method"],
            _rate(o["success"], n, row["success_ci95"]),
            _rate(o["collision"] + o["ttc"] + o["out_of_tank"], n, row["collision_ci95"]),
            _number(row["time_to_success_mean_s"]),
        )
    _stdout().print(table)


# ----------------------------------------------------------------------------------------------------------------- profile


@app.command()
def profile(
    num_envs: Annotated[str, typer.Option("--num-envs", help="Batch sizes, separated by commas.")] = "1,64,1024",
    controller: Annotated[str, typer.Option("--controller", help="Tree that is ticked.")] = "bt",
    preset: Annotated[str, typer.Option("--preset", help="Training preset: what learns in the rate with training.")] = "curriculum",
    world: World = "pool",
    sensors: Sensors = None,
    n_static: Static = None,
    n_dynamic: Dynamic = None,
    speed: Speed = None,
    seconds: Annotated[float, typer.Option("--seconds", help="Measured time per batch size \\[s].")] = 10.0,
    density: Annotated[bool, typer.Option("--density", help="Also loop time against D.")] = False,
    device: Device = "auto",
    overrides: Set = None,
    as_json: AsJson = False,
) -> None:
    """Time per stage, env-steps per second (simulated, with inference, with training), memory, and the paper's timing tables."""
    sizes = [_integer("--num-envs", text) for text in num_envs.split(",")]
    if not math.isfinite(seconds) or seconds <= 0:
        raise UsageError(f"--seconds {seconds}: must be a positive number, for example --seconds 10")
    from uuvtai.loader import load_training
    from uuvtai.measure.profiling import profile as run

    config = load_training(preset, [*_scene_flags(n_static, n_dynamic, speed), *(overrides or [])], world, sensors)

    result = run(config, sizes, controller, device, seconds, density, _say)
    if as_json:
        _print_json(result)
    else:
        _print_profile(result)


def _print_profile(result: dict[str, Any]) -> None:
    machine = f"{result['machine']['cpu']}, {result['machine']['cores']} cores, {result['machine']['device']}"
    table = Table(title=machine, title_justify="left")
    table.add_column("us per env-step")
    for row in result["rows"]:
        table.add_column(f"{row['num_envs']} env", justify="right")
    for stage in result["rows"][0]["stages_us_per_env_step"]:
        table.add_row(stage, *[f"{row['stages_us_per_env_step'][stage]:.2f}" for row in result["rows"]])
    table.add_section()
    for name, label in _RATES.items():
        table.add_row(f"env-steps/s: {label}", *[f"{row['env_steps_per_s'][name]:,.0f}" for row in result["rows"]])
    table.add_row("memory MB", *[f"{row['memory_mb']:,.0f}" for row in result["rows"]])
    table.add_row("compile s", *[f"{row['compile_s']:.1f}" for row in result["rows"]])
    _stdout().print(table)
    for row in result["rows"]:
        _print_flame(row)
    if result["paper_latency"]:
        _print_latency(result)
    if result["paper_density"]:
        _print_density(result["paper_density"])


_RATES = {"step": "random actions", "tree": "driven by the tree", "step_inference": "+ policy", "train": "+ training"}
_FLAME_WIDTH = 100
_FLAME_COLORS = ("blue", "cyan", "green", "yellow", "magenta", "red", "bright_blue", "bright_cyan", "bright_green", "bright_yellow")


def _print_flame(row: dict[str, Any]) -> None:
    """Stages of a step as one bar, each as wide as its share of the time."""
    from rich.text import Text

    stages = {name: us for name, us in row["stages_us_per_env_step"].items() if us > 0}
    total, bar, edge = sum(stages.values()), Text(), 0.0
    for (name, us), color in zip(stages.items(), _FLAME_COLORS * 2, strict=False):
        first, edge = round(_FLAME_WIDTH * edge / total), edge + us
        width = round(_FLAME_WIDTH * edge / total) - first
        bar.append(name[:width].ljust(width), style=f"black on {color}")
    _stdout().print(Text(f"{row['num_envs']:>6} env ").append(bar).append(f" {total:.1f} us"))


def _print_latency(result: dict[str, Any]) -> None:
    paper = Table(title="beside the paper's timing table (one env; theirs on a workstation with an RTX 5090)", title_justify="left")
    for head in ("component", "mean ms", "max ms", "paper mean ms", "paper max ms"):
        paper.add_column(head, justify="left" if head == "component" else "right")
    for row in result["paper_latency"]:
        if row["component"] == "Replanning rate":
            paper.caption = (
                f"{row['replans_per_episode']:.1f} replans an episode, {row['hz']:.2f} Hz "
                f"(paper: {row['paper_replans_per_episode']}, {row['paper_hz']} Hz)"
            )
            continue
        values = (row["mean_ms"], row["max_ms"], row["paper_mean_ms"], row["paper_max_ms"])
        paper.add_row(row["component"], *[_number(value, 3) for value in values])
    _stdout().print(paper)
    loop = result["real_time"]
    times = ", ".join(f"{name} {loop[f'{name}_ms']:.2f}" for name in ("p50", "p99", "max"))
    verdict = f"{loop['budget_ms']:.0f} ms a step {'kept' if loop['within'] else 'NOT kept'}"
    _stdout().print(f"{verdict}: {times} ms; {loop['late']} of {loop['steps']} steps late", highlight=False)


def _print_density(rows: list[dict[str, Any]]) -> None:
    table = Table(title="loop time against moving obstacles (one env)", title_justify="left")
    for head in ("D", "loop ms", "paper ms", "replans an episode", "paper replans"):
        table.add_column(head, justify="right")
    for row in rows:
        replans = _number(row["replans_per_episode"])
        table.add_row(str(row["D"]), _number(row["loop_ms"], 2), _number(row["paper_loop_ms"]), replans, _number(row["paper_replans"]))
    _stdout().print(table)


# --------------------------------------------------------------------------------------------------------------- reproduce


@app.command()
def reproduce(
    budget: Annotated[str, typer.Option("--budget", help="quick (half an hour on two cores) or full (overnight).")] = "quick",
    resume: Annotated[Path | None, typer.Option("--resume", help="Run folder of a reproduction to go on with.")] = None,
    run_dir: RunDir = None,
    as_json: AsJson = False,
) -> None:
    """Train, evaluate, sweep and profile whatever the paper shows, and judge each of its claims."""
    from uuvtai.measure.reproduce.run import reproduce as begin
    from uuvtai.measure.reproduce.run import resume as go_on

    if resume is not None:
        _refuse_beside_resume({"--run-dir": run_dir})
        result, folder = go_on(resume, _Progress())
    else:
        result, folder = begin(budget, run_dir, _Progress())
    if as_json:
        _print_json(result)
        return
    table = Table(title=f"the paper's claims, budget {result['budget']}", title_justify="left")
    for head in ("claim", "the paper", "here", "verdict"):
        table.add_column(head, overflow="fold")
    for claim in result["claims"]:
        color = {"holds": "green", "does not hold": "red"}.get(claim["verdict"], "yellow")
        table.add_row(claim["text"], claim["theirs"], claim["ours"], f"[{color}]{claim['verdict']}[/]")
    _stdout().print(table, highlight=False)
    _say(f"run folder: {folder}")


# ------------------------------------------------------------------------------------------------------------------ report


@app.command("report")
def report_run(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Run folders; several make one page: trainings are compared, the rest follows.")
    ],
    out: Annotated[Path | None, typer.Option("--out", help="The page \\[default: RUN/report.html]; figures/ is made beside it.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write one self-contained HTML page of a run: tables, figures, pictures, videos, and where they come from."""
    written = _write_report(runs, out)
    if as_json:
        _print_json({"schema": 1, "report": str(written.page), "figures": [str(path) for path in written.figures]})
    else:
        typer.echo(str(written.page))


def _write_report(runs: list[Path], out: Path | None) -> Any:
    from uuvtai.report.build import report

    return report(runs, out)


# ------------------------------------------------------------------------------------------------------------------ export


@app.command("export")
def export_policy(
    run: Annotated[str | None, typer.Argument(metavar="[RUN]", help="Run folder, checkpoint folder or shipped name (best).")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="New folder \\[default: runs/NAME_export].")] = None,
    evaluation: Annotated[
        list[Path] | None,
        typer.Option("--evaluation", help="Run folder of 'uuv eval RUN': counts for the model card (repeatable)."),
    ] = None,
    check: Annotated[Path | None, typer.Option("--check", help="Verify an exported folder instead: sha256 and golden pairs.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write a policy that drives without uuvtai (NumPy alone, or ONNX), or check such a folder. Exit code 3: it disagrees."""
    if (run is None) == (check is None):
        raise UsageError("give the RUN to export, or --check DIR for a folder that was exported")
    from uuvtai.deploy import export as deploy

    if check is not None:
        found = deploy.check(check, _say)
    else:
        from uuvtai.measure.methods import find_policy, policy_name

        assert run is not None
        checkpoint = find_policy(run, _say)
        name = policy_name(run, checkpoint)
        found = deploy.export(checkpoint, name, out or Path("runs") / f"{name}_export", evaluation or [], _say)
    if as_json:
        _print_json(found.document())
    else:
        _print_export(found)
    if not found.agrees:
        raise typer.Exit(GATE)


def _print_export(found: Any) -> None:
    for damage in found.damages:
        _say(damage)
    table = Table(title=str(found.folder), title_justify="left")
    for head in ("engine", "largest difference", "p50 ms", "p99 ms", ""):
        table.add_column(head, justify="right" if head else "left")
    for one in found.agreements:
        worst = max(one.difference, key=lambda name: one.difference[name])
        told = f"{one.difference[worst]:.1e} ({worst})"
        table.add_row(one.engine, told, f"{one.p50_ms:.3f}", f"{one.p99_ms:.3f}", "agrees" if one.agrees else "DIFFERS")
    if found.agreements:
        _stdout().print(table)


# --------------------------------------------------------------------------------------------------------- presets, doctor


@app.command()
def presets(
    action: Annotated[str | None, typer.Argument(help="'show' to print one preset, resolved.")] = None,
    name: Annotated[str | None, typer.Argument(help="Preset to show; KIND/NAME where two kinds have one of that name.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the shipped presets, or show one with every key."""
    from uuvtai import loader

    if action is None:
        found = {kind: loader.preset_names(kind) for kind in loader.KINDS}
        if as_json:
            _print_json(found)
            return
        for kind, names in found.items():
            _stdout().print(f"[bold]{kind}[/bold]  {', '.join(names) or '-'}")
        return
    if action != "show" or not name:
        raise UsageError("write 'uuv presets' or 'uuv presets show NAME'")
    kind, name = _preset_kind(name)
    if kind in ("tree", "grid"):
        if as_json and kind == "grid":
            _print_json(loader.read_preset(kind, name))
        else:
            typer.echo(loader.preset_path(kind, name).read_text())
        return
    config = _shown(kind, name)
    if as_json:
        _print_json(config.model_dump(mode="json"))
    else:
        typer.echo(loader.to_yaml(config))


def _preset_kind(name: str) -> tuple[str, str]:
    """(kind, name) of 'NAME' or 'KIND/NAME'; a path is taken for a world's. UsageError for a name that no kind has."""
    from uuvtai import loader

    kind, slash, rest = name.partition("/")
    if slash and kind in loader.KINDS:
        return kind, rest
    kinds = [kind for kind in loader.KINDS if name in loader.preset_names(kind)]
    for other in kinds[1:]:
        _say(f"there is another one: uuv presets show {other}/{name}")
    if not kinds and not slash and not Path(name).suffix:
        known = "; ".join(f"{kind}: {', '.join(names)}" for kind in loader.KINDS if (names := loader.preset_names(kind)))
        raise UsageError(f"{name!r} is no preset. There are {known}")
    return (kinds[0] if kinds else "world"), name


def _shown(kind: str, name: str) -> Any:
    """Config that a preset of this kind gives."""
    from uuvtai import loader

    if kind == "train":
        return loader.load_training(name)
    if kind == "policy":
        from uuvtai.measure.methods import find_policy

        return find_policy(name).config
    chosen = {"world": "pool", kind: name}
    return loader.load_config(chosen["world"], chosen.get("sensors"), chosen.get("vehicle"))


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Check that everything uuv needs is here and works."""
    from uuvtai.doctor import checks

    found = checks()
    if as_json:
        _print_json({"ok": all(c["ok"] for c in found), "checks": found})
    else:
        for c in found:
            _stdout().print(
                f"[{'green' if c['ok'] else 'red'}]{'ok ' if c['ok'] else 'BAD'}[/] {c['name']}: {c['detail']}", highlight=False
            )
    if not all(c["ok"] for c in found):
        raise typer.Exit(FAILED)


# -------------------------------------------------------------------------------------------------------------- tree, log


@app.command()
def tree(
    run: Annotated[Path | None, typer.Argument(help="Run folder of an evaluation; without one, the tree alone.")] = None,
    controller: Annotated[str, typer.Option("--controller", help="straight, planner, bt or a tree's XML.")] = "bt",
    dot: Annotated[bool, typer.Option("--dot", help="Print Graphviz DOT instead.")] = False,
    as_json: AsJson = False,
) -> None:
    """Print a behaviour tree, with the share of episodes and ticks per node after an evaluation."""
    from uuvtai.measure.tree_report import tree_report

    report = tree_report(controller, run)
    if as_json:
        _print_json(report.document)
    else:
        typer.echo(plain(report.dot if dot else report.text))


LogFile = Annotated[Path, typer.Argument(help="An .mcap file.")]


@log_app.command("info")
def log_info(file: LogFile, as_json: AsJson = False) -> None:
    """Topics, counts, rates, metadata and outcome of a log."""
    from uuvtai.logs import reader

    found = reader.info(file)
    if as_json:
        _print_json(found)
        return
    table = Table(title=str(file), title_justify="left")
    for head in ("topic", "schema", "messages", "Hz"):
        table.add_column(head, justify="right" if head in ("messages", "Hz") else "left")
    for topic in found["topics"]:
        table.add_row(Text(plain(topic["topic"])), Text(plain(topic["schema"])), str(topic["messages"]), _number(topic["rate_hz"]))
    _stdout().print(table)
    typer.echo(f"duration {found['duration_s']:.2f} s, outcome {plain(found['outcome'] or 'none: the log was cut off')}")


@log_app.command("export")
def log_export(
    file: LogFile,
    out: Annotated[Path, typer.Option("--out", help="Folder for the exported files.")],
    topic: Annotated[list[str] | None, typer.Option("--topic", help="Only these topics (repeatable).")] = None,
) -> None:
    """Write every topic as JSON lines and the attachments as files."""
    from uuvtai.logs import export

    for path in export.export(file, out, topic):
        typer.echo(str(path))


@log_app.command("repair")
def log_repair(
    file: LogFile, out: Annotated[Path | None, typer.Option("--out", help="Repaired file \\[default: NAME.repaired.mcap].")] = None
) -> None:
    """Recover the messages of a log whose writing was cut off."""
    from uuvtai.logs import repair

    found = repair.repair(file, out)
    for damage in found.damages:
        _say(damage)
    typer.echo(f"{found.path}: {found.messages} messages recovered, the last at {found.last_time_s:.2f} s")


@log_app.command("convert")
def log_convert(
    file: LogFile, out: Annotated[Path | None, typer.Option("--out", help="New file \\[default: NAME.protobuf.mcap].")] = None
) -> None:
    """Write a log with protobuf messages and point clouds, for Rerun and other viewers that do not read JSON."""
    from uuvtai.logs import convert

    target = out or file.with_suffix(".protobuf.mcap")
    typer.echo(f"{target}: {convert.convert(file, target)} messages")


@log_app.command("video")
def log_video(
    file: LogFile,
    out: Annotated[
        Path | None, typer.Option("--out", help="Its ending says the format: .webm, .mp4 or .gif \\[default: the log's name, .webm].")
    ] = None,
    speed: Annotated[float, typer.Option("--speed", help="Times as fast as it was.")] = 1.0,
    fps: Annotated[float | None, typer.Option("--fps", help="Frames per second \\[default: 15, GIF 10].")] = None,
    width: Annotated[int | None, typer.Option("--width", help="Width \\[px] \\[default: 1280, GIF 800].")] = None,
) -> None:
    """Render a top-down video of a recorded episode as WebM, MP4 or GIF."""
    from uuvtai.logs import video

    target = out or file.with_suffix(".webm")
    progress = _Progress("frames")

    def drawn(done: int, total: int) -> None:
        if done == 1:
            progress.start(target.name, total)
        progress.update(done, total, 0)

    try:
        video.video(file, target, width, fps, speed, drawn)
    finally:
        progress.stop()
    typer.echo(str(target))


@log_app.command("picture")
def log_picture(
    file: Annotated[list[Path], typer.Argument(help="Logs of the same episode; trajectories are overlaid.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Its ending says the format: .png, .pdf or .svg \\[default: the first log's name, .png].")
    ] = None,
    clearance: Annotated[bool, typer.Option("--clearance", help="Colour the clearance field.")] = False,
) -> None:
    """Draw a recorded episode as PNG, PDF or SVG: occupancy, trajectories, goal."""
    from uuvtai.logs import picture

    target = out or file[0].with_suffix(".png")
    picture.picture(file, target, clearance=clearance)
    typer.echo(str(target))


# ------------------------------------------------------------------------------------------------------- parsing and output


def _config(world, sensors, vehicle, n_static, n_dynamic, speed, overrides, first=()):
    """Config of presets, then ``first``, then -S -D -v, then --set."""
    from uuvtai.loader import load_config

    return load_config(world, sensors, vehicle, [*first, *_scene_flags(n_static, n_dynamic, speed), *(overrides or [])])


def _scene_flags(n_static: int | None, n_dynamic: int | None, speed: float | None) -> list[tuple[str, Any]]:
    flags = {"n_static": n_static, "n_dynamic": n_dynamic, "dynamic_speed_m_s": speed}
    return [(f"world.{key}", value) for key, value in flags.items() if value is not None]


def _seeds(text: str) -> list[int]:
    return [_integer("--seeds", item) for item in text.split(",")]


def _integer(option: str, text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        raise UsageError(f"{option} {text!r}: whole numbers separated by commas, for example {option} 0,1,2") from None
    if not -(2**31) <= value < 2**31:
        raise UsageError(f"{option} {text}: must fit 32 bits")
    return value


def _numbers(option: str, text: str | None, count: int) -> list[float] | None:
    if text is None:
        return None
    try:
        values = [float(item) for item in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise UsageError(f"{option} {text!r}: give {count} finite numbers separated by commas, without spaces")
    return values


def _at_least(option: str, value: int, least: int) -> None:
    if value < least:
        raise UsageError(f"{option} {value}: must be at least {least}")


def _print_json(document: Any) -> None:
    typer.echo(json.dumps(document, allow_nan=False))


def _stdout() -> Console:
    # a pipe has no width: wide enough that no column is cut
    return Console(width=None if sys.stdout.isatty() else 160)


def _say(text: str) -> None:
    typer.echo(plain(text), err=True)


def plain(text: str) -> str:
    """Text that a file may have brought along, without what would steer the terminal."""
    return "".join(c if c.isprintable() or c in "\n\t" else "?" for c in text)


class _Progress:
    """Rich progress with ETA on a terminal, one plain line every few seconds otherwise."""

    _PERIOD_S = 5.0

    def __init__(self, what: str = "episodes") -> None:
        self._bar = None
        self._last = 0.0
        self._what = what

    def start(self, name: str, total: int) -> None:
        """A method with ``total`` episodes begins."""
        import time

        self._name, self._total, self._begun = name, total, time.perf_counter()
        self._last = self._begun
        if sys.stderr.isatty():
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TextColumn("ETA"),
                TimeRemainingColumn(),
                TextColumn("{task.fields[rate]}"),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task(name, total=total, rate="")

    def note(self, text: str) -> None:
        """A message for the person who waits."""
        _say(text)

    def update(self, done: int, total: int, env_steps: int) -> None:
        """``done`` of ``total`` episodes are over after ``env_steps`` env steps."""
        import time

        now = time.perf_counter()
        speed = f"{env_steps / max(1e-9, now - self._begun):,.0f} env-steps/s" if env_steps else ""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, rate=speed)
        elif now - self._last >= self._PERIOD_S:
            self._last = now
            eta = (now - self._begun) / max(1, done) * (total - done)
            _say(f"{self._name}: {done}/{total} {self._what}, {speed + ', ' if speed else ''}ETA {eta:.0f} s")

    def stop(self) -> None:
        """The method is done."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit
    gc.set_threshold(50_000, 50, 1000)  # building kernels makes millions of objects, few of them garbage: half a second of a start


def main(arguments: list[str] | None = None) -> None:
    """Entry point: run a command and turn errors into one message and an exit code."""
    sys.exit(_guarded(lambda: app(args=arguments, prog_name="uuv", standalone_mode=False)))


def _guarded(run: Callable[[], Any]) -> int:
    try:
        code = run()
        if code == INTERRUPTED:  # Typer turns Ctrl-C into this
            _say("interrupted")
        return code if isinstance(code, int) else OK
    except UsageError.__base__ as error:
        error.show()
        return USAGE
    except (KeyboardInterrupt, typer.Abort):
        return _told("interrupted", INTERRUPTED)
    except BrokenPipeError:
        # the reader of our output has gone (| head): not an error of ours
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except (ValueError, MemoryError) as error:
        return _told(f"uuv: {error}", USAGE)
    except (RuntimeError, OSError) as error:
        return _told(f"uuv: {error}", FAILED)


def _told(text: str, code: int) -> int:
    _say(text)
    return code


if __name__ == "__main__":
    main()
