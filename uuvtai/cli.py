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
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from uuvtai import arguments, signals
from uuvtai import options as opt
from uuvtai.endings import FAILED, GATE, UsageError, guarded, plain, say
from uuvtai.scene_options import SceneOptions
from uuvtai.show.progress import Progress, counted
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


# ----------------------------------------------------------------------------------------------- eval, train


@app.command("eval", epilog="Example: uuv eval best --world gauntlet -D 9 -v 1.5 --episodes 64 --seeds 7")
def evaluate(
    ctx: typer.Context,
    runs: opt.EvalRuns = None,
    controller: opt.EvalControllers = None,
    planner: opt.Planners = None,
    policy: opt.Policies = None,
    world: opt.World = "pool",
    sensors: opt.Sensors = None,
    vehicle: opt.Vehicle = None,
    stack: opt.Stack = None,
    episodes: opt.EvalEpisodes = 64,
    seeds: opt.Seeds = "0",
    n_static: opt.Static = None,
    n_dynamic: opt.Dynamic = None,
    speed: opt.Speed = None,
    num_envs: opt.Batch = None,
    record: opt.Record = 0,
    video: opt.Video = False,
    depth_images: opt.DepthImages = False,
    explain: opt.Explain = False,
    explain_record: opt.ExplainRecord = None,
    resume: opt.EvalResume = None,
    allow_code: opt.AllowCode = False,
    device: opt.Device = "auto",
    overrides: opt.Set = None,
    with_report: opt.WithReport = False,
    run_dir: opt.RunDir = None,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Play the same episodes with every controller and trained policy and print the table of methods."""
    if resume is not None:
        arguments.refuse_beside_resume(ctx, ("allow_code",))
        from uuvtai.measure.evaluate.compare import resume as go_on

        result, folder = go_on(resume, Progress(), allow_code)
    else:
        seed_list = arguments.seeds(seeds)
        _refuse_counts(episodes, record, explain, explain_record)
        from uuvtai.measure.evaluate.compare import compare
        from uuvtai.measure.evaluate.eval_request import Request

        scene = SceneOptions(world, sensors, vehicle, stack, n_static, n_dynamic, speed, overrides)
        trained, controllers = arguments.drivers(runs, controller, planner, policy)
        request = Request.typed(
            scene, world, trained, controllers=controllers,
            seeds=seed_list, episodes=episodes, num_envs=num_envs, record=record, video=video,
            depth_images=depth_images, explain=explain,
            explain_record=3 if explain_record is None else explain_record, device=device, run_dir=run_dir,
        )  # fmt: skip
        result, folder = compare(request, Progress())
    from uuvtai.show.evaluation import show_evaluation

    _print(result, as_json, lambda: show_evaluation(Screen(wide), result, folder), folder)
    _report_if(with_report, folder)


def _refuse_counts(episodes: int, record: int, explain: bool, explain_record: int | None) -> None:
    arguments.refuse_less("--episodes", episodes, 1)
    arguments.refuse_less("--record", record, 0)
    if explain_record is not None:
        arguments.refuse_less("--explain-record", explain_record, 0)
        if not explain:
            raise UsageError("--explain-record: give --explain too, it says which episodes to record")


@app.command(
    "train",
    epilog="Example: uuv train curriculum --iterations 20 --set ppo.learning_rate=0.0005 --run-dir "
    "runs/first",
)
def train_policy(
    ctx: typer.Context,
    preset: opt.TrainPreset = None,
    resume: opt.TrainResume = None,
    iterations: opt.Iterations = None,
    num_envs: opt.TrainEnvs = None,
    seed: opt.TrainSeed = None,
    world: opt.TrainWorld = None,
    sensors: opt.TrainSensors = None,
    stack: opt.Stack = None,
    n_static: opt.Static = None,
    n_dynamic: opt.Dynamic = None,
    speed: opt.Speed = None,
    device: opt.Device = "auto",
    with_report: opt.WithReport = False,
    overrides: opt.Set = None,
    run_dir: opt.RunDir = None,
    as_json: opt.AsJson = False,
) -> None:
    """Train a policy into a run folder, or go on with one. Ctrl-C saves; --resume goes on."""
    from uuvtai.learn.run import TrainRequest, train
    from uuvtai.measure.evaluate.while_training import evaluate_now
    from uuvtai.show.dashboard import TrainingProgress

    if resume is None:
        scene = SceneOptions(world, sensors, None, stack, n_static, n_dynamic, speed, overrides)
        new = {"iterations": iterations, "device": device, "run_dir": run_dir}
        request = TrainRequest.typed(scene, preset or "best", num_envs, seed, **new)
    else:
        arguments.refuse_beside_resume(ctx, ("iterations", "device", "overrides"))
        request = TrainRequest(
            resume=resume, overrides=[*(overrides or [])], iterations=iterations, device=device
        )
    result, folder = train(request, TrainingProgress(), evaluate_now)
    _report_if(with_report, folder)
    if as_json:
        _print_json(result)


# --------------------------------------------------------------------------------------------------- simulate


@app.command(epilog="Example: uuv simulate --seconds 5 --wrench 10,0,0,0,0,0 --vehicle bluerov2_heavy")
def simulate(
    seconds: opt.SimulateSeconds,
    vehicle: opt.SimulateVehicle = "bluerov2",
    attitude_hold: opt.AttitudeHold = None,
    wrench: opt.Wrench = None,
    command: opt.Command = None,
    controller: opt.DrivenBy = None,
    planner: opt.Planners = None,
    policy: opt.Policies = None,
    current: opt.Current = None,
    initial_rpy_deg: opt.InitialRpy = None,
    initial_velocity: opt.InitialVelocity = None,
    neutral: opt.Neutral = False,
    dt: opt.Substep = 0.01,
    overrides: opt.Set = None,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Open-loop physics in open water, to validate a vehicle against theory or data; or, with --controller,
    one vehicle that is driven to a goal."""
    hold = [f"vehicle.attitude_hold={attitude_hold}"] if attitude_hold else []
    config = SceneOptions("open", "clean", vehicle, overrides=[*(overrides or []), *hold]).config()

    from uuvtai.measure.simulate import Trial
    from uuvtai.measure.simulate import simulate as run
    from uuvtai.show.simulation import show_simulation

    trial = Trial(
        seconds,
        wrench=arguments.numbers("--wrench", wrench, 6),
        command=arguments.numbers("--command", command, 4),
        current=arguments.numbers("--current", current, 3),
        initial_rpy_deg=arguments.numbers("--initial-rpy-deg", initial_rpy_deg, 3),
        initial_velocity=arguments.numbers("--initial-velocity", initial_velocity, 6),
        neutral=neutral,
        dt=dt,
    )
    title = f"{vehicle}: {seconds:g} s, substep {dt:g} s"
    driven = arguments.one_driver(controller, planner, policy)
    if driven is None:
        result = run(config, trial)
    else:
        from uuvtai.measure.driven import drive

        result = drive(config, trial, driven)
        goal = ", ".join(f"{value:.2f}" for value in result["goal"])
        title = f"{title}, {driven.removeprefix('controller:')} drives to ({goal})"
    _print(result, as_json, lambda: show_simulation(Screen(wide), result, title))


@app.command("watch", epilog="Example: uuv watch --world gauntlet --controller bt,dwa --episodes 4")
def watch_live(
    runs: opt.EvalRuns = None,
    controller: opt.WatchControllers = None,
    planner: opt.Planners = None,
    policy: opt.Policies = None,
    world: opt.World = "pool",
    sensors: opt.Sensors = None,
    vehicle: opt.Vehicle = None,
    stack: opt.Stack = None,
    episodes: opt.WatchEpisodes = 0,
    seeds: opt.Seeds = "0",
    n_static: opt.Static = None,
    n_dynamic: opt.Dynamic = None,
    speed: opt.Speed = None,
    rate: opt.Rate = 1.0,
    host: opt.Host = "127.0.0.1",
    port: opt.Port = 8765,
    depth_images: opt.DepthImages = False,
    device: opt.Device = "auto",
    overrides: opt.Set = None,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Run episodes in real time and serve them to Foxglove and Lichtblick."""
    seed_list = arguments.seeds(seeds)
    arguments.refuse_odd_live(episodes, rate, port)
    from uuvtai.measure.evaluate.eval_request import Request
    from uuvtai.measure.watching import LiveOptions, watch_episodes
    from uuvtai.show.live_episodes import show_watched

    scene = SceneOptions(world, sensors, vehicle, stack, n_static, n_dynamic, speed, overrides)
    alone = ["none"] if runs or planner or policy else ["bt"]
    trained, controllers = arguments.drivers(runs, controller or alone, planner, policy)
    request = Request.typed(
        scene, world, trained, controllers=controllers, seeds=seed_list, episodes=episodes,
        depth_images=depth_images, device=device,
    )  # fmt: skip
    result = watch_episodes(request, LiveOptions(host, port, rate), Progress())
    _print(result, as_json, lambda: show_watched(Screen(wide), result))


@app.command("drive", epilog="Example: uuv drive --world maze --rate 0.5")
def drive_vehicle(
    controller: opt.DriveControllers = None,
    world: opt.World = "pool",
    sensors: opt.Sensors = None,
    vehicle: opt.Vehicle = None,
    episodes: opt.DriveEpisodes = 1,
    seeds: opt.Seeds = "0",
    n_static: opt.Static = None,
    n_dynamic: opt.Dynamic = None,
    speed: opt.Speed = None,
    rate: opt.DriveRate = 1.0,
    overrides: opt.Set = None,
    run_dir: opt.RunDir = None,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Steer a vehicle by the keyboard, with the map that it makes; bt then plays the same episodes."""
    seed_list = arguments.seeds(seeds)
    arguments.refuse_less("--episodes", episodes, 1)
    arguments.refuse_odd_rate(rate, is_endless=False)
    from uuvtai.live.hand_driver import HandPiece
    from uuvtai.live.hand_steering import HELP
    from uuvtai.live.keyboard import keyboard
    from uuvtai.measure.evaluate.eval_request import Request
    from uuvtai.measure.hand_driving import drive_by_hand
    from uuvtai.show.evaluation import show_evaluation
    from uuvtai.show.live_episodes import Notes
    from uuvtai.show.steering_view import steering_view

    scene = SceneOptions(world, sensors, vehicle, None, n_static, n_dynamic, speed, overrides)
    named = [name for name in arguments.drivers(None, controller or ["bt"], None, None)[1] if name != "none"]
    request = Request.typed(
        scene, world, [], controllers=named, seeds=seed_list, episodes=episodes, device="cpu", run_dir=run_dir
    )
    with keyboard() as keys, steering_view(HELP) as show:
        result, folder = drive_by_hand(request, HandPiece(keys, show, rate), Notes())
    _print(result, as_json, lambda: show_evaluation(Screen(wide), result, folder), folder)


# --------------------------------------------------------------------------------------------------- identify


@app.command("identify", epilog="Example: uuv identify drive.csv --vehicle bluerov2_16v --out mine.yaml")
def identify_vehicle(
    file: opt.DriveLogs,
    vehicle: opt.SimulateVehicle = "bluerov2_16v",
    known: opt.IdentifyKnown = "gain",
    truth: opt.IdentifyTruth = False,
    out: opt.IdentifyOut = None,
    overrides: opt.Set = None,
    force: opt.IdentifyForce = False,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Drag, added mass, buoyancy and thruster gain of a vehicle from logs of its drives, with intervals."""
    from uuvtai.identify.identify_files import identify

    target = out or file[0].with_suffix(".vehicle.yaml")
    base = SceneOptions("open", "clean", vehicle, overrides=overrides).config().vehicle
    document = identify(file, base, vehicle, known, truth, target, force)

    from uuvtai.show.identification import show_identified

    title = f"{file[0].name}: {document['seconds']:g} s of drives, known: {known} of {vehicle}"
    _print(document, as_json, lambda: show_identified(Screen(wide), document, title))
    say(f"wrote {target}")


# ------------------------------------------------------------------------------------------------------ sweep


@app.command(epilog="Example: uuv sweep best --grid D=0,6 --grid v=0.4,1.5 --episodes 16 --workers 2")
def sweep(
    ctx: typer.Context,
    runs: opt.SweepRuns = None,
    controller: opt.SweepControllers = None,
    planner: opt.Planners = None,
    policy: opt.Policies = None,
    grid: opt.GridAxes = None,
    world: opt.World = "pool",
    sensors: opt.Sensors = None,
    vehicle: opt.Vehicle = None,
    stack: opt.Stack = None,
    n_static: opt.Static = None,
    n_dynamic: opt.Dynamic = None,
    speed: opt.Speed = None,
    episodes: opt.SweepEpisodes = 64,
    seeds: opt.Seeds = "0",
    num_envs: opt.Batch = None,
    engine: opt.EngineName = "local",
    workers: opt.Workers = 1,
    address: opt.Address = "auto",
    resume: opt.SweepResume = None,
    allow_code: opt.AllowCode = False,
    device: opt.Device = "auto",
    with_report: opt.WithReport = False,
    overrides: opt.Set = None,
    run_dir: opt.RunDir = None,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Play every cell of a grid with every method; finished cells survive a kill: --resume goes on."""
    from uuvtai.measure.sweep import play
    from uuvtai.measure.sweep.cells import grid_of
    from uuvtai.measure.sweep.engines import engine_of
    from uuvtai.measure.sweep.plan import SweepRequest
    from uuvtai.show.sweeping import show_sweep

    arguments.refuse_less("--episodes", episodes, 1)
    arguments.refuse_less("--workers", workers, 1)
    progress = Progress("cells")
    if resume is not None:
        arguments.refuse_beside_resume(ctx, _SWEEP_RESUME)
        result, folder = play.resume(resume, engine_of(engine, workers, address), progress, allow_code)
    else:
        scene = SceneOptions(world, sensors, vehicle, stack, n_static, n_dynamic, speed, overrides)
        trained, controllers = arguments.drivers(runs, controller or ["bt"], planner, policy)
        request = SweepRequest.typed(
            scene, world, trained, grid=grid_of(grid or []), controllers=tuple(controllers),
            seeds=tuple(arguments.seeds(seeds)), episodes=episodes, num_envs=num_envs, device=device,
        )  # fmt: skip
        result, folder = play.sweep(request, engine_of(engine, workers, address), run_dir, progress)
    _report_if(with_report, folder)
    _print(result, as_json, lambda: show_sweep(Screen(wide), result), folder)


_SWEEP_RESUME = ("allow_code", "world", "episodes", "seeds", "engine", "workers", "address", "device")


# -------------------------------------------------------------------------------------------------- benchmark


@app.command("benchmark", epilog="Example: uuv benchmark pool --controller examples/own_field.py --quick")
def enter_benchmark(
    name: opt.BenchmarkName = None,
    file: opt.EntryFile = None,
    controller: opt.EntryController = None,
    planner: opt.Planners = None,
    policy: opt.Policies = None,
    quick: opt.Quick = False,
    sample: opt.Sample = None,
    num_envs: opt.Batch = None,
    device: opt.Device = "auto",
    run_dir: opt.RunDir = None,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Play fixed scenes that others play too, and write what came of it as a file; or check such a file.
    Exit code 3: an entry disagrees with its replay."""
    from uuvtai.show import benchmarking

    arguments.refuse_odd_benchmark(name, file, quick, sample, num_envs, run_dir)
    if name is None:
        from uuvtai.measure.benchmark.benchmark_scenes import catalogue

        found = catalogue()
        _print(found, as_json, lambda: benchmarking.show_scenes(Screen(wide), found))
        return
    from uuvtai.measure.benchmark import entering, entrant, verifying

    given = controller or planner or policy
    who = [controller] if controller else ["none"] if given else ["bt"]
    pilot = entrant.entrant_of(*arguments.drivers(None, who, planner, policy))
    if file is None:
        asked = entering.BenchmarkRequest(name, pilot, quick, num_envs, device, run_dir)
        entry, folder = entering.enter(asked, Progress())
        path = folder / entering.FILE
        _print(entry, as_json, lambda: benchmarking.show_entry(Screen(wide), entry, path))
        return
    most = verifying.SAMPLE if sample is None else sample
    checked = verifying.verify(file, pilot if given else None, Progress(), most, device)
    _print(checked, as_json, lambda: benchmarking.show_check(Screen(wide), checked))
    if not checked["ok"]:
        raise typer.Exit(GATE)


# ----------------------------------------------------------------------------------------- profile, reproduce


@app.command(epilog="Example: uuv profile --num-envs 1,64 --seconds 5")
def profile(
    num_envs: opt.BatchSizes = "1,64,1024",
    controller: opt.TickedTree = "bt",
    preset: opt.ProfilePreset = "curriculum",
    world: opt.World = "pool",
    sensors: opt.Sensors = None,
    stack: opt.Stack = None,
    n_static: opt.Static = None,
    n_dynamic: opt.Dynamic = None,
    speed: opt.Speed = None,
    seconds: opt.ProfileSeconds = 10.0,
    density: opt.Density = False,
    device: opt.Device = "auto",
    overrides: opt.Set = None,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Time per stage, env-steps per second (simulated, with inference, with training), memory, and the
    paper's timing tables."""
    sizes = [arguments.integer("--num-envs", text) for text in num_envs.split(",")]
    if not math.isfinite(seconds) or seconds <= 0:
        raise UsageError(f"--seconds {seconds}: must be a positive number, for example --seconds 10")
    from uuvtai.measure.profile.profiling import profile as run
    from uuvtai.show.profile import show_profile

    scene = SceneOptions(world, sensors, None, stack, n_static, n_dynamic, speed, overrides)
    result = run(scene.training(preset), sizes, controller, device, seconds, density, say)
    _print(result, as_json, lambda: show_profile(Screen(wide), result))


@app.command(epilog="Example: uuv reproduce --budget quick --run-dir runs/reproduction")
def reproduce(
    ctx: typer.Context,
    budget: opt.BudgetName = "quick",
    controller: opt.OwnControllers = None,
    planner: opt.Planners = None,
    policy: opt.Policies = None,
    allow_code: opt.AllowCode = False,
    resume: opt.ReproduceResume = None,
    run_dir: opt.RunDir = None,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Train, evaluate, sweep and profile whatever the paper shows, and judge each of its claims."""
    from uuvtai.measure.reproduce import paper_run
    from uuvtai.tables.claim_table import claim_table

    if resume is not None:
        arguments.refuse_beside_resume(ctx, ("budget", "allow_code"))
        result, folder = paper_run.resume(resume, Progress(), allow_code)
    else:
        own = arguments.own_pieces(controller, planner, policy)
        result, folder = paper_run.reproduce(budget, run_dir, Progress(), own)
    _print(result, as_json, lambda: Screen(wide).table(claim_table(result)), folder)


# --------------------------------------------------------------------------------------------- report, export


@app.command("report", epilog="Example: uuv report runs/first")
def report_run(
    runs: opt.ReportRuns,
    out: opt.ReportOut = None,
    paper: opt.ReportPaper = None,
    force: opt.ReportForce = False,
    as_json: opt.AsJson = False,
) -> None:
    """Write one self-contained HTML page of a run: tables, figures, pictures, videos, and where they come
    from; or, with --paper, figures and tables for a paper."""
    if paper is not None:
        if out is not None or force:
            raise UsageError("--paper: writes a folder of its own; leave out --out and --force")
        from uuvtai.report.paper_kit import paper as write_paper

        kit = write_paper(runs, paper)
        _print(kit.document(), as_json, lambda: typer.echo(str(kit.folder)))
        return
    from uuvtai.report.build import report

    written = report(runs, out, force)
    document = {"schema": 1, "report": str(written.page), "figures": list(map(str, written.figures))}
    _print(document, as_json, lambda: typer.echo(str(written.page)))


def _report_if(with_report: bool, folder: Path) -> None:
    if with_report:
        from uuvtai.report.build import report

        say(f"report: {report([folder]).page}")


@app.command("export", epilog="Example: uuv export best --out runs/best_export")
def export_policy(
    run: opt.ExportRun = None,
    out: opt.ExportOut = None,
    evaluation: opt.ExportEvaluation = None,
    check: opt.ExportCheck = None,
    wide: opt.Wide = False,
    force: opt.ExportForce = False,
    as_json: opt.AsJson = False,
) -> None:
    """Write a policy that drives without uuvtai (NumPy alone, or ONNX), or check such a folder. Exit code 3:
    it disagrees."""
    if (run is None) == (check is None):
        raise UsageError("give the RUN to export, or --check DIR for a folder that was exported")
    from uuvtai.deploy import export
    from uuvtai.show.exports import show_export

    if check is not None:
        found = export.check(check, say)
    else:
        from uuvtai.measure.episodes.methods import find_policy, policy_name

        assert run is not None
        checkpoint = find_policy(run, say)
        name = policy_name(run, checkpoint)
        target = out or Path("runs") / f"{name}_export"
        found = export.export(checkpoint, name, target, evaluation or [], say, force)
    _print(found.document(), as_json, lambda: show_export(Screen(wide), found))
    if not found.agrees:
        raise typer.Exit(GATE)


# --------------------------------------------------------------------------------------------------- replay


@app.command("replay", epilog="Example: uuv replay runs/first/logs/bt_seed0_episode0.mcap --lose dvl:10:15")
def replay_log(
    log: opt.ReplayLog,
    controller: opt.ReplayTree = None,
    drop: opt.Drop = 0.0,
    jitter: opt.Jitter = 0.0,
    lose: opt.Lose = None,
    fault_seed: opt.FaultSeed = 0,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Feed a log's sensor messages to the stack again, without the simulator, and compare the commands. Exit
    code 3: they differ, though nothing was disturbed."""
    arguments.refuse_less("--fault-seed", fault_seed, 0)
    from uuvtai.measure.replay.faults import Faults, outage_of
    from uuvtai.measure.replay.replaying import replay
    from uuvtai.show.replays import show_replay

    faults = Faults(drop, jitter, tuple(map(outage_of, lose or [])), fault_seed)
    found = replay(log, faults, controller)
    _print(found, as_json, lambda: show_replay(Screen(wide), found))
    if not (found["equal"] or found["faults"]["any"]):
        raise typer.Exit(GATE)


# --------------------------------------------------------------------------------------------------- vehicle


@app.command(
    "pilot", epilog="Example: uuv pilot --mavlink udp:127.0.0.1:14550 --start 2,3,-0.8 --goal 18,3,-0.8"
)
def pilot_vehicle(
    mavlink: opt.Mavlink,
    start: opt.PilotStart,
    goal: opt.PilotGoal,
    arm: opt.Arm = False,
    heading: opt.Heading = None,
    controller: opt.PilotTree = "bt",
    world: opt.World = "pool",
    sensors: opt.Sensors = "multibeam",
    vehicle: opt.Vehicle = None,
    box: opt.FenceBox = None,
    depth: opt.FenceDepth = None,
    max_speed: opt.MostSpeed = 0.5,
    battery: opt.LeastBattery = 13.2,
    system: opt.VehicleId = 1,
    operator: opt.OperatorId = 255,
    seconds: opt.PilotSeconds = None,
    rate: opt.PilotRate = 1.0,
    log: opt.PilotLog = None,
    overrides: opt.Set = None,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Drive a real vehicle, or ArduSub's simulated one, by MAVLink; a dry run unless --arm is typed
    (docs/safety.md). Exit code 3: it ended by a safe action."""
    arguments.refuse_odd_rate(rate, is_endless=False)
    from uuvtai.link.flight_plan import FlightPlan
    from uuvtai.link.onboard_loop import fly
    from uuvtai.show.flights import show_flight
    from uuvtai.tree import read_tree

    config = SceneOptions(world, sensors, vehicle, overrides=overrides).config()
    plan = FlightPlan.typed(
        config, mavlink, arguments.numbers("--start", start, 3), arguments.numbers("--goal", goal, 3),
        arguments.numbers("--box", box, 4), arguments.numbers("--depth", depth, 2), max_speed, battery,
        arms=arm, heading_deg=heading, seconds=seconds, rate=rate, log=log, system=system, operator=operator,
    )  # fmt: skip
    found = fly(config, read_tree(controller, config.teacher.max_node), plan, say)
    _print(found, as_json, lambda: show_flight(Screen(wide), found))
    if not found["safe"]:
        raise typer.Exit(GATE)


@app.command("sitl", epilog="Example: uuv sitl --world pool -S 8 -D 6 -v 0.6 --instances 3")
def serve_sitl(
    world: opt.World = "pool",
    sensors: opt.Sensors = "multibeam",
    vehicle: opt.Vehicle = "bluerov2_16v",
    n_static: opt.Static = None,
    n_dynamic: opt.Dynamic = None,
    speed: opt.Speed = None,
    seed: opt.SitlSeed = 0,
    episode: opt.SitlEpisode = 0,
    instances: opt.Instances = 1,
    port: opt.SitlPort = 9002,
    host: opt.SitlHost = "127.0.0.1",
    mavlink: opt.SensorPlaces = None,
    rate: opt.SitlRate = 0.0,
    seconds: opt.SitlSeconds = None,
    once: opt.SitlOnce = False,
    overrides: opt.Set = None,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Be the water for ArduSub: our physics, world and sensors behind its JSON interface (docs/sitl.md)."""
    arguments.refuse_odd_rate(rate)
    from uuvtai.show.flights import show_sitl
    from uuvtai.sitl.serving import SitlPlan, serve_water
    from uuvtai.tree import read_tree

    config = SceneOptions(world, sensors, vehicle, None, n_static, n_dynamic, speed, overrides).config()
    plan = SitlPlan.typed(host, port, instances, mavlink, rate, seconds, once, seed, episode)
    found = serve_water(config, read_tree("straight", config.teacher.max_node), plan, say)
    _print(found, as_json, lambda: show_sitl(Screen(wide), found))


# -------------------------------------------------------------------------------------- presets, doctor, tree


@app.command(epilog="Example: uuv presets show gauntlet")
def presets(
    action: opt.PresetsAction = None,
    name: opt.PresetName = None,
    everything: opt.Everything = False,
    as_json: opt.AsJson = False,
) -> None:
    """List the shipped presets with a sentence each, or show what one of them states."""
    from uuvtai.show import presets as shown

    if action is None:
        _print(shown.sentences(), as_json, lambda: shown.show_presets(Screen()))
        return
    if action != "show" or not name:
        raise UsageError("write 'uuv presets' or 'uuv presets show NAME'")
    kind, name = shown.kind_and_name(name)
    if not everything or kind == "tree":  # a tree has no keys
        shown.show_stated(kind, name, as_json)
        return
    from uuvtai import loader

    if kind == "grid":
        found = loader.read_preset(kind, name)
        _print(found, as_json, lambda: typer.echo(loader.dumped(found)))
        return
    config = _config_of(kind, name)
    _print(config.model_dump(mode="json"), as_json, lambda: typer.echo(loader.to_yaml(config)))


def _config_of(kind: str, name: str) -> Any:
    """Config that a preset of this kind gives."""
    if kind == "train":
        return SceneOptions().training(name)
    if kind == "policy":
        from uuvtai.measure.episodes.methods import find_policy

        return find_policy(name).config
    chosen: dict[str, Any] = {kind: name}
    return SceneOptions(**chosen).config()


@app.command(epilog="Example: uuv doctor --json")
def doctor(clean: opt.Clean = False, as_json: opt.AsJson = False) -> None:
    """Check that everything uuv needs is here and works."""
    from uuvtai.doctor import checks
    from uuvtai.doctor import clean as delete_machine_code
    from uuvtai.show.health import show_checks

    if clean:
        typer.echo(f"deleted {delete_machine_code()} files of machine code", err=True)
    found = checks()
    is_ok = all(check["ok"] for check in found)
    _print({"ok": is_ok, "checks": found}, as_json, lambda: show_checks(Screen(), found))
    if not is_ok:
        raise typer.Exit(FAILED)


@app.command(epilog="Example: uuv warm --sensors nominal,paper --num-envs 64,256")
def warm(
    num_envs: opt.BatchSizes = "1,8,64,256",
    world: opt.World = "pool",
    sensors: opt.WarmSensors = "nominal,paper",
    overrides: opt.Set = None,
    workers: opt.WarmWorkers = 0,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Compile beforehand what later commands need, so that they start at once (docs/native.md)."""
    from uuvtai.show.health import show_shapes
    from uuvtai.sizes import check_size
    from uuvtai.warming import Shape
    from uuvtai.warming import warm as run

    sizes = [arguments.integer("--num-envs", text) for text in num_envs.split(",")]
    if workers < 0:
        raise UsageError(f"--workers {workers}: must be 1 or more, for example --workers 2")
    scenes = [SceneOptions(world, name, overrides=overrides) for name in sensors.split(",")]
    shapes = [Shape(scene, size) for scene in scenes for size in sizes]
    for shape in shapes:
        check_size(shape.scene.config(), shape.num_envs, "cpu")
    say(f"sizes to compile: {len(shapes)}, about a minute each the first time")
    found = run(shapes, workers or None)
    _print({"shapes": found}, as_json, lambda: show_shapes(Screen(wide), found))


@app.command(epilog="Example: uuv tree --controller planner --dot")
def tree(
    run: opt.EvaluatedRun = None,
    controller: opt.ShownTree = "bt",
    dot: opt.Dot = False,
    wide: opt.Wide = False,
    as_json: opt.AsJson = False,
) -> None:
    """Print a behaviour tree, with the share of episodes and ticks per node after an evaluation."""
    from uuvtai.measure.evaluate.tree_report import tree_report

    report = tree_report(controller, run)
    if as_json:
        _print_json(report.document)
    elif dot or run is None:
        typer.echo(plain(report.dot if dot else report.text))
    else:
        from uuvtai.show.trees import show_tree

        show_tree(Screen(wide), report.text, report.document["nodes"])


# -------------------------------------------------------------------------------------------------------- log


@log_app.command("info", epilog="Example: uuv log info runs/first/logs/bt_seed0_episode0.mcap")
def log_info(file: opt.LogFile, wide: opt.Wide = False, as_json: opt.AsJson = False) -> None:
    """Topics, counts, rates, metadata and outcome of a log."""
    from uuvtai.logs import reader
    from uuvtai.show.logs import show_log

    found = reader.info(file)
    _print(found, as_json, lambda: show_log(Screen(wide), found, file))


@log_app.command(
    "export", epilog="Example: uuv log export runs/first/logs/bt_seed0_episode0.mcap --out exported"
)
def log_export(
    file: opt.LogFile, out: opt.LogExportOut, topic: opt.Topics = None, fmt: opt.LogFormat = "json"
) -> None:
    """Write every topic as a file, and the attachments below attachments/."""
    from uuvtai.logs import log_export

    for path in log_export.export(file, out, topic, fmt):
        typer.echo(str(path))


@log_app.command("repair", epilog="Example: uuv log repair runs/first/logs/bt_seed0_episode0.mcap")
def log_repair(file: opt.LogFile, out: opt.RepairOut = None, force: opt.LogForce = False) -> None:
    """Recover the messages of a log whose writing was cut off."""
    from uuvtai.logs import repair

    found = repair.repair(file, out, force)
    for damage in found.damages:
        say(damage)
    typer.echo(f"{found.path}: {found.messages} messages recovered, the last at {found.last_time_s:.2f} s")


@log_app.command("convert", epilog="Example: uuv log convert runs/first/logs/bt_seed0_episode0.mcap")
def log_convert(
    file: opt.LogFile,
    out: opt.ConvertOut = None,
    to: opt.ConvertTo = "protobuf",
    source: opt.ConvertFrom = "mcap",
    force: opt.LogForce = False,
) -> None:
    """Write a log with protobuf messages and point clouds for Rerun, or as a ROS 2 bag; or a bag as a log."""
    from uuvtai.logs.conversions import converted

    target, messages = converted(file, out, to, source, force)
    typer.echo(f"{target}: {messages} messages")


@log_app.command("video", epilog="Example: uuv log video runs/first/logs/bt_seed0_episode0.mcap")
def log_video(
    file: opt.FilmLogs,
    out: opt.VideoOut = None,
    speed: opt.VideoSpeed = 1.0,
    fps: opt.VideoFps = None,
    width: opt.VideoWidth = None,
    force: opt.LogForce = False,
) -> None:
    """Render a top-down video of a recorded episode as WebM, MP4 or GIF; of several, a grid of tanks."""
    from uuvtai.files import refuse_output

    target = out or file[0].with_suffix(".webm")
    refuse_output(target, file, force)
    with counted(target.name, "frames") as drawn:
        if len(file) > 1:
            from uuvtai.logs.overview import overview

            overview(file, target, width, fps, speed, drawn)
        else:
            from uuvtai.logs.video import video

            video(file[0], target, width, fps, speed, drawn)
    typer.echo(str(target))


@log_app.command("picture", epilog="Example: uuv log picture runs/first/logs/bt_seed0_episode0.mcap")
def log_picture(
    file: opt.LogFiles,
    out: opt.PictureOut = None,
    clearance: opt.WithClearance = False,
    force: opt.LogForce = False,
) -> None:
    """Draw a recorded episode as PNG, PDF or SVG: occupancy, trajectories, goal."""
    from uuvtai.files import refuse_output
    from uuvtai.logs import picture

    target = out or file[0].with_suffix(".png")
    refuse_output(target, file, force)
    picture.picture(file, target, clearance=clearance)
    typer.echo(str(target))


# ----------------------------------------------------------------------------------------------- the program


def _print(document: Any, as_json: bool, show: Callable[[], None], folder: Path | None = None) -> None:
    """The result, for a program or for a person, who also hears of the run's ``folder``."""
    if as_json:
        _print_json(document)
        return
    show()
    if folder is not None:
        say(f"run folder: {folder}")


def _print_json(document: Any) -> None:
    typer.echo(json.dumps(document, allow_nan=False))


@app.callback(invoke_without_command=True)
def _root(
    ctx: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit
    if ctx.invoked_subcommand in ("report", "export", "log", "doctor"):
        signals.engage()  # the others have nothing to tidy up before they have a run folder
    # building kernels makes millions of objects, few of them garbage: half a second of a start
    gc.set_threshold(50_000, 50, 1000)


def main(arguments: list[str] | None = None) -> None:
    """Run a command and leave with its exit code. ``uuv`` itself begins in ``uuvtai.entry``."""
    code = guarded(lambda: app(args=arguments, prog_name="uuv", standalone_mode=False))
    signals.finish(code)
    sys.exit(code)


if __name__ == "__main__":
    main()
