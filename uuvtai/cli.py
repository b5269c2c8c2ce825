"""The command line ``uuv``: parse, load the preset, call one function, print.

Results go to stdout, progress and messages to stderr. Exit codes: 0 ok, 1 failed (a bug of ours, or the
machine: a full disk), 2 refused, with what to type instead, 3 a gate was not met, 130 or 143 interrupted
(SIGINT, SIGTERM). Heavy packages are imported inside the commands, so that ``uuv --help`` is quick.
"""

from __future__ import annotations

import gc
import json
import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from uuvtai import signals
from uuvtai.endings import FAILED, GATE, UsageError, guarded, plain
from uuvtai.endings import say as _say
from uuvtai.shipped import KINDS, preset_names
from uuvtai.show import choices
from uuvtai.show.progress import Progress
from uuvtai.show.screen import Screen
from uuvtai.version import __version__

app = typer.Typer(
    name="uuv",
    help="Train, measure and inspect observation-only navigation for underwater vehicles.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Example: uuv eval --world gauntlet --episodes 16 --record 1",
)
log_app = typer.Typer(
    help="Look into recorded episodes (MCAP).",
    no_args_is_help=True,
    epilog="Example: uuv log info runs/first/logs/bt_seed0_episode0.mcap",
)
app.add_typer(log_app, name="log")

_WORLDS, _SENSORS, _VEHICLES = (choices.names(kind) for kind in ("world", "sensors", "vehicle"))
_NAME = "NAME|FILE"

World = Annotated[
    str,
    typer.Option(
        "--world",
        metavar=_NAME,
        help=f"World: {_WORLDS}, or a YAML file.",
        autocompletion=choices.presets("world"),
    ),
]
Sensors = Annotated[
    str | None,
    typer.Option(
        "--sensors",
        metavar=_NAME,
        help=f"Sensors: {_SENSORS}, or a YAML file \\[default: the world's own, else paper].",
        autocompletion=choices.presets("sensors"),
    ),
]
Vehicle = Annotated[
    str | None,
    typer.Option(
        "--vehicle",
        metavar=_NAME,
        help=f"Vehicle: {_VEHICLES}, or a YAML file \\[default: the world's own, else bluerov2].",
        autocompletion=choices.presets("vehicle"),
    ),
]
Static = Annotated[int | None, typer.Option("-S", help="Static obstacles.")]
Dynamic = Annotated[int | None, typer.Option("-D", help="Moving obstacles.")]
Speed = Annotated[float | None, typer.Option("-v", help="Speed of the moving obstacles \\[m/s].")]
Stack = Annotated[
    str | None,
    typer.Option(
        "--stack",
        metavar=_NAME,
        help=f"How the classical half works: {choices.names('stack')} (as in the paper), or a YAML file "
        "\\[default: ours].",
        autocompletion=choices.presets("stack"),
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a config key: key.sub=value (repeatable)."),
]
Device = Annotated[str, choices.device()]
RunDir = Annotated[
    Path | None, typer.Option("--run-dir", help="The run's folder \\[default: runs/TIME_PRESET].")
]
WithReport = Annotated[bool, typer.Option("--report", help="Also write the run's report.html.")]
Wide = Annotated[
    bool, typer.Option("--wide", help="Show every column of a table, though the terminal be narrower.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else on stdout.")]


# ------------------------------------------------------------------------------------------------------- eval


@app.command("eval", epilog="Example: uuv eval best --world gauntlet -D 9 -v 1.5 --episodes 64 --seeds 7")
def evaluate(
    ctx: typer.Context,
    runs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="RUN",
            help="Trained policies: run folders, checkpoint folders or shipped names "
            f"({choices.names('policy')}).",
            autocompletion=choices.policies,
        ),
    ] = None,
    controller: Annotated[
        list[str] | None,
        typer.Option(
            "--controller",
            metavar="NAME|FILE",
            autocompletion=choices.controllers,
            help="straight, planner, bt or a tree's XML (repeatable); paper = bt on the paper's own stack, a "
            "row of its own; "
            "none = policies alone \\[default: straight, planner, bt, beside a RUN bt]. "
            "Privileged yardsticks: NAME+truth (a tree that knows where every moving body is), oracle (knows "
            "the future: an upper bound).",
        ),
    ] = None,
    world: World = "pool",
    sensors: Sensors = None,
    vehicle: Vehicle = None,
    stack: Stack = None,
    episodes: Annotated[int, typer.Option("--episodes", help="Episodes per seed.")] = 64,
    seeds: Annotated[str, typer.Option("--seeds", "--seed", help="Seeds, separated by commas.")] = "0",
    n_static: Static = None,
    n_dynamic: Dynamic = None,
    speed: Speed = None,
    num_envs: Annotated[
        int | None,
        typer.Option("--num-envs", help="Episodes played together \\[default: as many as sensible]."),
    ] = None,
    record: Annotated[
        int,
        typer.Option("--record", help="Record the first K episodes of every method as MCAP with a picture."),
    ] = 0,
    video: Annotated[
        bool, typer.Option("--video", help="Also a top-down video of every recorded episode.")
    ] = False,
    depth_images: Annotated[
        bool, typer.Option("--depth-images", help="Also record the depth camera (2 Hz).")
    ] = False,
    explain: Annotated[
        bool,
        typer.Option(
            "--explain",
            help="Label the cause of every failure, judged from the truth: which sense or decision failed.",
        ),
    ] = False,
    explain_record: Annotated[
        int | None,
        typer.Option(
            "--explain-record",
            help="With --explain: log, picture, video of N of the worst failures per method \\[default: 3].",
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume",
            help="Run folder of an interrupted evaluation to go on with.",
            autocompletion=choices.runs,
        ),
    ] = None,
    device: Device = "auto",
    overrides: Set = None,
    with_report: WithReport = False,
    run_dir: RunDir = None,
    wide: Wide = False,
    as_json: AsJson = False,
) -> None:
    """Play the same episodes with every controller and trained policy and print the table of methods."""
    if resume is not None:
        from uuvtai.measure.evaluate.compare import resume as go_on

        _refuse_all_beside_resume(ctx, ("with_report", "as_json", "wide"))
        result, folder = go_on(resume, _Progress())
        _finish_evaluation(result, folder, as_json, wide, with_report)
        return
    seed_list = _seeds(seeds)
    _at_least("--episodes", episodes, 1)
    _at_least("--record", record, 0)
    if explain_record is not None:
        _at_least("--explain-record", explain_record, 0)
        if not explain:
            raise UsageError("--explain-record: give --explain too, it says which episodes to record")
    policies = runs or []
    config = _config(
        world,
        sensors,
        vehicle,
        n_static,
        n_dynamic,
        speed,
        overrides,
        [*_policy_features(policies), *_stack(stack)],
    )

    from uuvtai.loader import sensors_of
    from uuvtai.measure.evaluate.compare import Request, compare

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
    _finish_evaluation(result, folder, as_json, wide, with_report)


def _finish_evaluation(
    result: dict[str, Any], folder: Path, as_json: bool, wide: bool, with_report: bool
) -> None:
    _print_evaluation(result, folder, as_json, wide)
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
    from uuvtai.measure.episodes.methods import features_of

    return features_of(policies)


def _print_evaluation(result: dict[str, Any], folder: Path, as_json: bool, wide: bool) -> None:
    if as_json:
        _print_json(result)
        return
    from uuvtai.show.cause_table import show_causes
    from uuvtai.show.evaluation import show_methods, show_pairs, show_risk

    screen = Screen(wide)
    show_methods(screen, result)
    show_pairs(screen, result["paired"])
    for method in result["methods"]:
        if "risk" in method:
            show_risk(screen, method["name"], method["risk"])
    if any("causes" in method for method in result["methods"]):
        show_causes(screen, result)
        _say(f"facts of every failure, and which of them are recorded: {folder / 'eval/explain.json'}")
    _say(f"run folder: {folder}")


# ------------------------------------------------------------------------------------------------------ train


@app.command(
    "train",
    epilog="Example: uuv train curriculum --iterations 20 --set ppo.learning_rate=0.0005 --run-dir "
    "runs/first",
)
def train_policy(
    preset: Annotated[
        str | None,
        typer.Argument(
            metavar="PRESET",
            help=f"Training preset: {choices.names('train')}, or a YAML file \\[default: best].",
            autocompletion=choices.presets("train"),
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume", help="Run folder to go on with, with its own config.", autocompletion=choices.runs
        ),
    ] = None,
    iterations: Annotated[
        int | None,
        typer.Option(
            "--iterations",
            help="Stop when so many are done in all; schedules run over train.iterations in any case.",
        ),
    ] = None,
    num_envs: Annotated[
        int | None, typer.Option("--num-envs", help="Envs stepped together (train.num_envs).")
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", help="Seed of networks, exploration and scenarios (train.seed).")
    ] = None,
    world: Annotated[
        str | None,
        typer.Option(
            "--world",
            metavar=_NAME,
            help=f"World: {_WORLDS}, or a YAML file \\[default: the training preset's].",
            autocompletion=choices.presets("world"),
        ),
    ] = None,
    sensors: Annotated[
        str | None,
        typer.Option(
            "--sensors",
            metavar=_NAME,
            help=f"Sensors: {_SENSORS}, or a YAML file \\[default: the training preset's].",
            autocompletion=choices.presets("sensors"),
        ),
    ] = None,
    stack: Stack = None,
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
    from uuvtai.learn.run import TrainRequest, train
    from uuvtai.loader import load_training
    from uuvtai.measure.evaluate.while_training import evaluate_now
    from uuvtai.show.dashboard import TrainingProgress

    if resume is None:
        sizes = [
            (f"train.{key}", value)
            for key, value in (("num_envs", num_envs), ("seed", seed))
            if value is not None
        ]
        chosen = preset or "best"
        typed = [*sizes, *_stack(stack), *_scene_flags(n_static, n_dynamic, speed), *(overrides or [])]
        config = load_training(chosen, typed, world, sensors)
        request = TrainRequest(
            config=config, preset=chosen, iterations=iterations, device=device, run_dir=run_dir
        )
    else:
        given = {
            "PRESET": preset,
            "--num-envs": num_envs,
            "--seed": seed,
            "--world": world,
            "--sensors": sensors,
        }
        given |= {"--stack": stack, "-S": n_static, "-D": n_dynamic, "-v": speed, "--run-dir": run_dir}
        _refuse_beside_resume(given)
        request = TrainRequest(
            resume=resume, overrides=list(overrides or []), iterations=iterations, device=device
        )
    result, folder = train(request, TrainingProgress(), evaluate_now)
    if with_report:
        _say(f"report: {_write_report([folder], None).page}")
    if as_json:
        _print_json(result)


def _refuse_beside_resume(given: dict[str, Any]) -> None:
    for option, value in given.items():
        if value is not None:
            raise UsageError(
                f"{option} {value}: a resumed run keeps its own; leave it out, or begin a new run without "
                "--resume"
            )


def _refuse_all_beside_resume(ctx: typer.Context, allowed: tuple[str, ...]) -> None:
    """UsageError for whatever else was typed, be it a default's value."""
    for parameter in ctx.command.params:
        name = parameter.name or ""
        source = ctx.get_parameter_source(name)
        if name not in ("resume", *allowed) and source is not None and source.name == "COMMANDLINE":
            _refuse_beside_resume(
                {parameter.opts[0] if parameter.param_type_name == "option" else "RUN": ctx.params[name]}
            )


# --------------------------------------------------------------------------------------------------- simulate


@app.command(epilog="Example: uuv simulate --seconds 5 --wrench 10,0,0,0,0,0 --vehicle bluerov2_heavy")
def simulate(
    seconds: Annotated[float, typer.Option("--seconds", help="Duration \\[s].")],
    vehicle: Annotated[
        str,
        typer.Option(
            "--vehicle",
            metavar=_NAME,
            help=f"Vehicle: {_VEHICLES}, or a YAML file.",
            autocompletion=choices.presets("vehicle"),
        ),
    ] = "bluerov2",
    attitude_hold: Annotated[
        str | None,
        choices.choice(
            "--attitude-hold",
            ("ideal", "thrusters", "none"),
            "What holds roll and pitch \\[default: the vehicle's own].",
        ),
    ] = None,
    wrench: Annotated[
        str | None, typer.Option("--wrench", help="Constant body wrench fx,fy,fz,mx,my,mz [N, N m].")
    ] = None,
    command: Annotated[
        str | None,
        typer.Option("--command", help="Body velocity command u,v,w,r \\[m/s, rad/s] for the inner loop."),
    ] = None,
    current: Annotated[str | None, typer.Option("--current", help="Water velocity x,y,z \\[m/s].")] = None,
    initial_rpy_deg: Annotated[
        str | None, typer.Option("--initial-rpy-deg", help="Roll, pitch, yaw \\[deg].")
    ] = None,
    initial_velocity: Annotated[
        str | None, typer.Option("--initial-velocity", help="u,v,w,p,q,r \\[m/s, rad/s].")
    ] = None,
    neutral: Annotated[bool, typer.Option("--neutral", help="Buoyancy equal to weight.")] = False,
    dt: Annotated[float, typer.Option("--dt", help="Dynamics substep \\[s].")] = 0.01,
    overrides: Set = None,
    wide: Wide = False,
    as_json: AsJson = False,
) -> None:
    """Open-loop physics in open water, to validate a vehicle against theory or data."""
    extra = [f"vehicle.attitude_hold={attitude_hold}"] if attitude_hold else []
    config = _config("open", "clean", vehicle, None, None, None, [*(overrides or []), *extra])

    from uuvtai.measure.simulate import Trial
    from uuvtai.measure.simulate import simulate as run

    trial = Trial(
        seconds,
        wrench=_numbers("--wrench", wrench, 6),
        command=_numbers("--command", command, 4),
        current=_numbers("--current", current, 3),
        initial_rpy_deg=_numbers("--initial-rpy-deg", initial_rpy_deg, 3),
        initial_velocity=_numbers("--initial-velocity", initial_velocity, 6),
        neutral=neutral,
        dt=dt,
    )
    result = run(config, trial)
    if as_json:
        _print_json(result)
        return
    from uuvtai.show.simulation import show_simulation

    show_simulation(Screen(wide), result, f"{vehicle}: {seconds:g} s, substep {dt:g} s")


# ------------------------------------------------------------------------------------------------------ sweep


@app.command(epilog="Example: uuv sweep best --grid D=0,6 --grid v=0.4,1.5 --episodes 16 --workers 2")
def sweep(
    runs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[RUN]...", help="Trained policies, as for eval.", autocompletion=choices.policies
        ),
    ] = None,
    controller: Annotated[
        list[str] | None,
        typer.Option(
            "--controller",
            metavar="NAME|FILE",
            help="straight, planner, bt or a tree's XML (repeatable) \\[default: bt].",
            autocompletion=choices.controllers,
        ),
    ] = None,
    grid: Annotated[
        list[str] | None,
        typer.Option(
            "--grid",
            metavar="NAME|AXIS=VALUES",
            help="AXIS=value,value,.. (repeatable: S, D, v, sensors, vehicle, any config key) or a preset: "
            f"{choices.names('grid')} \\[default: paper].",
            autocompletion=choices.grids,
        ),
    ] = None,
    world: World = "pool",
    sensors: Sensors = None,
    vehicle: Vehicle = None,
    stack: Stack = None,
    n_static: Static = None,
    n_dynamic: Dynamic = None,
    speed: Speed = None,
    episodes: Annotated[int, typer.Option("--episodes", help="Episodes per seed, cell and method.")] = 64,
    seeds: Annotated[str, typer.Option("--seeds", "--seed", help="Seeds, separated by commas.")] = "0",
    num_envs: Annotated[
        int | None,
        typer.Option("--num-envs", help="Episodes played together \\[default: as many as sensible]."),
    ] = None,
    engine: Annotated[
        str,
        choices.choice("--engine", ("local", "ray"), "Who works: processes on this machine, or a cluster."),
    ] = "local",
    workers: Annotated[int, typer.Option("--workers", help="Processes of the local engine.")] = 1,
    address: Annotated[
        str, typer.Option("--address", help="Ray cluster: host:port, auto, or local (inside this process).")
    ] = "auto",
    resume: Annotated[
        Path | None,
        typer.Option("--resume", help="Run folder of a sweep to go on with.", autocompletion=choices.runs),
    ] = None,
    device: Device = "auto",
    with_report: WithReport = False,
    overrides: Set = None,
    run_dir: RunDir = None,
    wide: Wide = False,
    as_json: AsJson = False,
) -> None:
    """Play every cell of a grid with every method; finished cells survive a kill: --resume goes on."""
    from uuvtai.measure.sweep.cells import grid_of
    from uuvtai.measure.sweep.plan import SweepRequest
    from uuvtai.measure.sweep.play import resume as go_on
    from uuvtai.measure.sweep.play import sweep as begin

    _at_least("--episodes", episodes, 1)
    _at_least("--workers", workers, 1)
    if resume is not None:
        given = {
            "RUN": runs,
            "--controller": controller,
            "--grid": grid,
            "--set": overrides,
            "--run-dir": run_dir,
            "--num-envs": num_envs,
        }
        given |= {
            "--sensors": sensors,
            "--vehicle": vehicle,
            "--stack": stack,
            "-S": n_static,
            "-D": n_dynamic,
            "-v": speed,
        }
        _refuse_beside_resume(given)
        result, folder = go_on(resume, _engine(engine, workers, address), _Progress("cells"))
    else:
        policies = runs or []
        request = SweepRequest(
            grid=grid_of(grid or []),
            world=world,
            sensors=sensors,
            vehicle=vehicle,
            overrides=(*_stack(stack), *_scene_flags(n_static, n_dynamic, speed), *(overrides or [])),
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
    from uuvtai.show.sweeping import show_sweep

    show_sweep(Screen(wide), result)
    _say(f"run folder: {folder}")


def _engine(name: str, workers: int, address: str) -> Any:
    from uuvtai.measure.sweep.engines import LocalEngine, RayEngine

    return LocalEngine(workers) if name == "local" else RayEngine(address)


# ---------------------------------------------------------------------------------------------------- profile


@app.command(epilog="Example: uuv profile --num-envs 1,64 --seconds 5")
def profile(
    num_envs: Annotated[
        str, typer.Option("--num-envs", help="Batch sizes, separated by commas.")
    ] = "1,64,1024",
    controller: Annotated[
        str,
        typer.Option(
            "--controller",
            metavar="NAME|FILE",
            help=f"Tree that is ticked: {choices.names('tree')}, or an XML file.",
            autocompletion=choices.presets("tree", suffix=".xml"),
        ),
    ] = "bt",
    preset: Annotated[
        str,
        typer.Option(
            "--preset",
            metavar=_NAME,
            help=f"What learns in the rate with training: {choices.names('train')}, or a YAML file.",
            autocompletion=choices.presets("train"),
        ),
    ] = "curriculum",
    world: World = "pool",
    sensors: Sensors = None,
    stack: Stack = None,
    n_static: Static = None,
    n_dynamic: Dynamic = None,
    speed: Speed = None,
    seconds: Annotated[float, typer.Option("--seconds", help="Measured time per batch size \\[s].")] = 10.0,
    density: Annotated[bool, typer.Option("--density", help="Also loop time against D.")] = False,
    device: Device = "auto",
    overrides: Set = None,
    wide: Wide = False,
    as_json: AsJson = False,
) -> None:
    """Time per stage, env-steps per second (simulated, with inference, with training), memory, and the
    paper's timing tables."""
    sizes = [_integer("--num-envs", text) for text in num_envs.split(",")]
    if not math.isfinite(seconds) or seconds <= 0:
        raise UsageError(f"--seconds {seconds}: must be a positive number, for example --seconds 10")
    from uuvtai.loader import load_training
    from uuvtai.measure.profile.profiling import profile as run

    config = load_training(
        preset,
        [*_stack(stack), *_scene_flags(n_static, n_dynamic, speed), *(overrides or [])],
        world,
        sensors,
    )

    result = run(config, sizes, controller, device, seconds, density, _say)
    if as_json:
        _print_json(result)
        return
    from uuvtai.show.profile import show_profile

    show_profile(Screen(wide), result)


# -------------------------------------------------------------------------------------------------- reproduce


@app.command(epilog="Example: uuv reproduce --budget quick --run-dir runs/reproduction")
def reproduce(
    budget: Annotated[
        str,
        choices.choice("--budget", ("quick", "full"), "How much: half an hour on two cores, or overnight."),
    ] = "quick",
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume", help="Run folder of a reproduction to go on with.", autocompletion=choices.runs
        ),
    ] = None,
    run_dir: RunDir = None,
    wide: Wide = False,
    as_json: AsJson = False,
) -> None:
    """Train, evaluate, sweep and profile whatever the paper shows, and judge each of its claims."""
    from uuvtai.measure.reproduce.paper_run import reproduce as begin
    from uuvtai.measure.reproduce.paper_run import resume as go_on

    if resume is not None:
        _refuse_beside_resume({"--run-dir": run_dir})
        result, folder = go_on(resume, _Progress())
    else:
        result, folder = begin(budget, run_dir, _Progress())
    if as_json:
        _print_json(result)
        return
    from uuvtai.show.verdicts import show_claims

    show_claims(Screen(wide), result)
    _say(f"run folder: {folder}")


# ----------------------------------------------------------------------------------------------------- report


@app.command("report", epilog="Example: uuv report runs/first")
def report_run(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN...",
            help="Run folders; several make one page: trainings are compared, the rest follows.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="The page \\[default: RUN/report.html]; figures/ is made beside it."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there already.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write one self-contained HTML page of a run: tables, figures, pictures, videos, and where they come
    from."""
    written = _write_report(runs, out, force)
    if as_json:
        _print_json(
            {"schema": 1, "report": str(written.page), "figures": [str(path) for path in written.figures]}
        )
    else:
        typer.echo(str(written.page))


def _write_report(runs: list[Path], out: Path | None, force: bool = False) -> Any:
    from uuvtai.report.build import report

    return report(runs, out, force)


# ----------------------------------------------------------------------------------------------------- export


@app.command("export", epilog="Example: uuv export best --out runs/best_export")
def export_policy(
    run: Annotated[
        str | None,
        typer.Argument(
            metavar="[RUN]",
            help="Run folder, checkpoint folder or shipped name (best).",
            autocompletion=choices.policies,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="New folder \\[default: runs/NAME_export].")
    ] = None,
    evaluation: Annotated[
        list[Path] | None,
        typer.Option(
            "--evaluation", help="Run folder of 'uuv eval RUN': counts for the model card (repeatable)."
        ),
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option("--check", help="Verify an exported folder instead: sha256 and golden pairs."),
    ] = None,
    wide: Wide = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the exported policy that --out names.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write a policy that drives without uuvtai (NumPy alone, or ONNX), or check such a folder. Exit code 3:
    it disagrees."""
    if (run is None) == (check is None):
        raise UsageError("give the RUN to export, or --check DIR for a folder that was exported")
    from uuvtai.deploy import export as deploy

    if check is not None:
        found = deploy.check(check, _say)
    else:
        from uuvtai.measure.episodes.methods import find_policy, policy_name

        assert run is not None
        checkpoint = find_policy(run, _say)
        name = policy_name(run, checkpoint)
        found = deploy.export(
            checkpoint, name, out or Path("runs") / f"{name}_export", evaluation or [], _say, force
        )
    if as_json:
        _print_json(found.document())
    else:
        _print_export(found, wide)
    if not found.agrees:
        raise typer.Exit(GATE)


def _print_export(found: Any, wide: bool) -> None:
    from uuvtai.show.exports import show_export

    for damage in found.damages:
        _say(damage)
    show_export(Screen(wide), found)


# -------------------------------------------------------------------------------------------- presets, doctor


@app.command(epilog="Example: uuv presets show gauntlet")
def presets(
    action: Annotated[
        str | None,
        typer.Argument(
            metavar="show",
            help="'show' to print one preset as it is written.",
            autocompletion=lambda: ["show"],
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME",
            help="Preset to show; KIND/NAME where two kinds have one of that name.",
            autocompletion=choices.shown,
        ),
    ] = None,
    everything: Annotated[
        bool,
        typer.Option(
            "--all",
            help="With show: every key that the preset gives, its own, those it builds on, and the defaults.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """List the shipped presets with a sentence each, or show what one of them states."""
    from uuvtai.show import presets as shown

    if action is None:
        if as_json:
            _print_json(shown.sentences())
        else:
            shown.show_presets(Screen())
        return
    if action != "show" or not name:
        raise UsageError("write 'uuv presets' or 'uuv presets show NAME'")
    kind, name = _preset_kind(name)
    if everything:
        _print_resolved(kind, name, as_json)
    else:
        _print_stated(kind, name, as_json)


def _print_stated(kind: str, name: str, as_json: bool) -> None:
    """What a preset states itself."""
    from uuvtai import loader
    from uuvtai.show.presets import stated

    path = loader.preset_path(kind, name)
    if not as_json:
        typer.echo(stated(path))
        if (base := loader.base_of(path)) is not None:
            _say(f"it changes these keys of {base} (uuv presets show {kind}/{base}); every key: --all")
    elif path.suffix in (".xml", ".md"):
        _print_json({"schema": 1, "text": stated(path)})
    else:
        _print_json(loader.stated(path))


def _print_resolved(kind: str, name: str, as_json: bool) -> None:
    """Every key that a preset gives; of a tree, which has none, what it states."""
    from uuvtai import loader

    if kind == "tree":
        _print_stated(kind, name, as_json)
    elif kind == "grid":
        found = loader.read_preset(kind, name)
        if as_json:
            _print_json(found)
        else:
            typer.echo(loader.dumped(found))
    elif as_json:
        _print_json(_shown(kind, name).model_dump(mode="json"))
    else:
        typer.echo(loader.to_yaml(_shown(kind, name)))


def _preset_kind(name: str) -> tuple[str, str]:
    """(kind, name) of 'NAME' or 'KIND/NAME'; a path is taken for a world's. UsageError for a name that no
    kind has."""
    from uuvtai.show.presets import near

    kind, slash, rest = name.partition("/")
    if slash and kind in KINDS:
        return kind, rest
    kinds = [kind for kind in KINDS if name in preset_names(kind)]
    for other in kinds[1:]:
        _say(f"there is another one: uuv presets show {other}/{name}")
    if not kinds and not slash and not Path(name).suffix:
        known = "; ".join(f"{kind}: {', '.join(names)}" for kind in KINDS if (names := preset_names(kind)))
        raise UsageError(f"{name!r} is no preset{near(name) or '.'} There are {known}")
    return (kinds[0] if kinds else "world"), name


def _shown(kind: str, name: str) -> Any:
    """Config that a preset of this kind gives."""
    from uuvtai import loader

    if kind == "train":
        return loader.load_training(name)
    if kind == "policy":
        from uuvtai.measure.episodes.methods import find_policy

        return find_policy(name).config
    chosen = {"world": "pool", kind: name}
    stack = {"stack": name} if kind == "stack" else {}
    return loader.load_config(chosen["world"], chosen.get("sensors"), chosen.get("vehicle"), stack)


@app.command(epilog="Example: uuv doctor --json")
def doctor(as_json: AsJson = False) -> None:
    """Check that everything uuv needs is here and works."""
    from uuvtai.doctor import checks

    found = checks()
    if as_json:
        _print_json({"ok": all(c["ok"] for c in found), "checks": found})
    else:
        from uuvtai.show.health import show_checks

        show_checks(Screen(), found)
    if not all(c["ok"] for c in found):
        raise typer.Exit(FAILED)


# -------------------------------------------------------------------------------------------------- tree, log


@app.command(epilog="Example: uuv tree --controller planner --dot")
def tree(
    run: Annotated[
        Path | None,
        typer.Argument(
            metavar="RUN",
            help="Run folder of an evaluation; without one, the tree alone.",
            autocompletion=choices.evaluations,
        ),
    ] = None,
    controller: Annotated[
        str,
        typer.Option(
            "--controller",
            metavar="NAME|FILE",
            help=f"Tree: {choices.names('tree')}, or an XML file.",
            autocompletion=choices.presets("tree", suffix=".xml"),
        ),
    ] = "bt",
    dot: Annotated[bool, typer.Option("--dot", help="Print Graphviz DOT instead.")] = False,
    wide: Wide = False,
    as_json: AsJson = False,
) -> None:
    """Print a behaviour tree, with the share of episodes and ticks per node after an evaluation."""
    from uuvtai.measure.evaluate.tree_report import tree_report

    report = tree_report(controller, run)
    if as_json:
        _print_json(report.document)
    elif dot:
        typer.echo(plain(report.dot))
    elif run is not None:
        from uuvtai.show.trees import show_tree

        show_tree(Screen(wide), report.text, report.document["nodes"])
    else:
        typer.echo(plain(report.text))


LogFile = Annotated[Path, typer.Argument(help="An .mcap file.")]
Force = Annotated[bool, typer.Option("--force", help="Replace the file that --out names.")]


@log_app.command("info", epilog="Example: uuv log info runs/first/logs/bt_seed0_episode0.mcap")
def log_info(file: LogFile, wide: Wide = False, as_json: AsJson = False) -> None:
    """Topics, counts, rates, metadata and outcome of a log."""
    from uuvtai.logs import reader

    found = reader.info(file)
    if as_json:
        _print_json(found)
        return
    from uuvtai.show.logs import show_log

    show_log(Screen(wide), found, file)
    if found["converted_from"]:
        typer.echo(
            "output of uuv log convert (protobuf); for every other command use "
            f"{plain(found['converted_from'])}"
        )


@log_app.command(
    "export", epilog="Example: uuv log export runs/first/logs/bt_seed0_episode0.mcap --out exported"
)
def log_export(
    file: LogFile,
    out: Annotated[Path, typer.Option("--out", help="New or empty folder for the exported files.")],
    topic: Annotated[
        list[str] | None, typer.Option("--topic", help="Only these topics (repeatable).")
    ] = None,
    fmt: Annotated[
        str, typer.Option("--format", help="json (a line a message), csv or npz (NumPy arrays).")
    ] = "json",
) -> None:
    """Write every topic as a file, and the attachments below attachments/."""
    from uuvtai.logs import log_export

    for path in log_export.export(file, out, topic, fmt):
        typer.echo(str(path))


@log_app.command("repair", epilog="Example: uuv log repair runs/first/logs/bt_seed0_episode0.mcap")
def log_repair(
    file: LogFile,
    out: Annotated[
        Path | None, typer.Option("--out", help="Repaired file \\[default: NAME.repaired.mcap].")
    ] = None,
    force: Force = False,
) -> None:
    """Recover the messages of a log whose writing was cut off."""
    from uuvtai.logs import repair

    found = repair.repair(file, out, force)
    for damage in found.damages:
        _say(damage)
    typer.echo(f"{found.path}: {found.messages} messages recovered, the last at {found.last_time_s:.2f} s")


@log_app.command("convert", epilog="Example: uuv log convert runs/first/logs/bt_seed0_episode0.mcap")
def log_convert(
    file: LogFile,
    out: Annotated[
        Path | None, typer.Option("--out", help="New file \\[default: NAME.protobuf.mcap].")
    ] = None,
    force: Force = False,
) -> None:
    """Write a log with protobuf messages and point clouds, for Rerun and other viewers that do not read
    JSON."""
    from uuvtai.logs import convert

    target = out or file.with_suffix(".protobuf.mcap")
    typer.echo(f"{target}: {convert.convert(file, target, force)} messages")


@log_app.command("video", epilog="Example: uuv log video runs/first/logs/bt_seed0_episode0.mcap")
def log_video(
    file: LogFile,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Its ending says the format: .webm, .mp4 or .gif \\[default: the log's name, .webm].",
        ),
    ] = None,
    speed: Annotated[float, typer.Option("--speed", help="Times as fast as it was.")] = 1.0,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frames per second \\[default: 15, GIF 10].")
    ] = None,
    width: Annotated[
        int | None, typer.Option("--width", help="Width \\[px] \\[default: 1280, GIF 800].")
    ] = None,
    force: Force = False,
) -> None:
    """Render a top-down video of a recorded episode as WebM, MP4 or GIF."""
    from uuvtai.files import refuse_output
    from uuvtai.logs import video

    target = out or file.with_suffix(".webm")
    refuse_output(target, [file], force)
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


@log_app.command("picture", epilog="Example: uuv log picture runs/first/logs/bt_seed0_episode0.mcap")
def log_picture(
    file: Annotated[list[Path], typer.Argument(help="Logs of the same episode; trajectories are overlaid.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Its ending says the format: .png, .pdf or .svg \\[default: the first log's name, .png].",
        ),
    ] = None,
    clearance: Annotated[bool, typer.Option("--clearance", help="Colour the clearance field.")] = False,
    force: Force = False,
) -> None:
    """Draw a recorded episode as PNG, PDF or SVG: occupancy, trajectories, goal."""
    from uuvtai.files import refuse_output
    from uuvtai.logs import picture

    target = out or file[0].with_suffix(".png")
    refuse_output(target, file, force)
    picture.picture(file, target, clearance=clearance)
    typer.echo(str(target))


# ----------------------------------------------------------------------------------------- parsing and output


def _config(world, sensors, vehicle, n_static, n_dynamic, speed, overrides, first=()):
    """Config of presets, then ``first``, then -S -D -v, then --set."""
    from uuvtai.loader import load_config

    return load_config(
        world, sensors, vehicle, [*first, *_scene_flags(n_static, n_dynamic, speed), *(overrides or [])]
    )


def _scene_flags(n_static: int | None, n_dynamic: int | None, speed: float | None) -> list[tuple[str, Any]]:
    flags = {"n_static": n_static, "n_dynamic": n_dynamic, "dynamic_speed_m_s": speed}
    return [(f"world.{key}", value) for key, value in flags.items() if value is not None]


def _stack(name: str | None) -> list[tuple[str, Any]]:
    return [] if name is None else [("stack", name)]


def _seeds(text: str) -> list[int]:
    return [_integer("--seeds", item) for item in text.split(",")]


def _integer(option: str, text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        raise UsageError(
            f"{option} {text!r}: whole numbers separated by commas, for example {option} 0,1,2"
        ) from None
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
        raise UsageError(
            f"{option} {text!r}: give {count} finite numbers separated by commas, without spaces"
        )
    return values


def _at_least(option: str, value: int, least: int) -> None:
    if value < least:
        raise UsageError(f"{option} {value}: must be at least {least}")


def _print_json(document: Any) -> None:
    typer.echo(json.dumps(document, allow_nan=False))


_Progress = Progress


@app.callback(invoke_without_command=True)
def _root(
    ctx: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit
    if ctx.invoked_subcommand in (
        "report",
        "export",
        "log",
        "doctor",
    ):  # others have nothing to tidy up before they have a run folder
        signals.engage()
    gc.set_threshold(
        50_000, 50, 1000
    )  # building kernels makes millions of objects, few of them garbage: half a second of a start


def main(arguments: list[str] | None = None) -> None:
    """Run a command and leave with its exit code. ``uuv`` itself begins in ``uuvtai.entry``."""
    code = guarded(lambda: app(args=arguments, prog_name="uuv", standalone_mode=False))
    signals.finish(code)
    sys.exit(code)


if __name__ == "__main__":
    main()
