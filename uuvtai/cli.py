"""The command line ``uuv``: parse, load the preset, call one function, print.

Results go to stdout, progress and messages to stderr. Exit codes: 0 ok, 1 failed (a bug of ours, or the
machine: a full disk), 2 refused, with what to type instead, 3 a gate was not met, 130 or 143 interrupted
(SIGINT, SIGTERM). Heavy packages are imported inside the commands, so that ``uuv --help`` is quick.
"""

from __future__ import annotations

import gc
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from uuvtai.common import signals
from uuvtai.common.exits import FAILED, GATE, UsageError, guarded, say
from uuvtai.common.files import refuse_output
from uuvtai.common.version import __version__
from uuvtai.console import groups, parsing
from uuvtai.console import options as opt
from uuvtai.console.screen import Progress, counted
from uuvtai.sim.scene import SceneOptions

app = typer.Typer(
    name="uuv",
    cls=groups.Commands,
    help="Train, measure and inspect observation-only navigation for underwater vehicles.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Example: uuv eval --world gauntlet --episodes 16 --record 1",
)
log_app = typer.Typer(
    help="Read, import, convert, repair and draw recorded episodes (MCAP).",
    no_args_is_help=True,
    epilog="Example: uuv log info runs/first/logs/bt_seed0_episode0.mcap",
)


# ------------------------------------------------------------------------------------------------------- Run


@app.command("eval", epilog="Example: uuv eval --agent best --world gauntlet -D 9 --speed 1.5 --seeds 7")
@groups.grouped
def evaluate(
    ctx: typer.Context,
    agents: groups.AgentsGroup,
    scene: groups.SceneGroup,
    *,
    episodes: opt.EvalEpisodes = 64,
    seeds: opt.Seeds = "0",
    kept: groups.RecordingGroup,
    output: groups.OutputGroup,
    num_envs: opt.Batch = None,
    resume: opt.EvalResume = None,
    allow_code: opt.AllowCode = False,
    device: opt.Device = "auto",
    with_report: opt.WithReport = False,
    run_dir: opt.RunDir = None,
) -> None:
    """Run agents on the same episodes and compare them."""
    if resume is not None:
        parsing.refuse_beside_resume(ctx, ("allow_code",))
        from uuvtai.evaluation.evaluate import resume as go_on

        result, folder = go_on(resume, Progress(), allow_code)
    else:
        seed_list = parsing.seeds("--seeds", seeds)
        parsing.refuse_less("--episodes", episodes, 1)
        recording = kept.asked()
        from uuvtai.evaluation.evaluate import compare
        from uuvtai.evaluation.results import Request

        request = Request.typed(
            scene, agents.named(), seeds=seed_list, episodes=episodes, num_envs=num_envs, device=device,
            run_dir=run_dir, **recording,
        )  # fmt: skip
        result, folder = compare(request, Progress())
    from uuvtai.console.views import show_evaluation

    output.show(result, lambda screen: show_evaluation(screen, result, folder), folder)
    _report_if(with_report, folder, "uuv report")


@app.command(epilog="Example: uuv demo --open")
@groups.grouped
def demo(
    output: groups.PlainOutputGroup, episodes: opt.EvalEpisodes = 64, open_page: opt.OpenPage = False
) -> None:
    """Compare three agents in a pool, with a report to play.

    The same as uuv eval --record 2 --report, for a first look."""
    parsing.refuse_less("--episodes", episodes, 1)
    from uuvtai.console.views import show_evaluation
    from uuvtai.evaluation.evaluate import compare
    from uuvtai.evaluation.results import Request

    agents = [*groups.AgentsGroup.default]
    asked = {"seeds": [0], "episodes": episodes, "record": 2}
    result, folder = compare(Request.typed(groups.SceneGroup(), agents, **asked), Progress())
    output.show(result, lambda screen: show_evaluation(screen, result, folder), folder)
    _report_if(True, folder, opens=open_page)
    say("next: uuv eval --agent bt --world gauntlet -D 9 --speed 1.5 --explain --report")


@app.command(epilog="Example: uuv sweep --agent best --grid D=0,6 --grid v=0.4,1.5 --workers 2")
@groups.grouped
def sweep(
    ctx: typer.Context,
    agents: groups.AgentsOrTreeGroup,
    scene: groups.SceneGroup,
    place: groups.WorkplaceGroup,
    output: groups.OutputGroup,
    grid: opt.GridAxes = None,
    episodes: opt.SweepEpisodes = 64,
    seeds: opt.Seeds = "0",
    num_envs: opt.Batch = None,
    resume: opt.SweepResume = None,
    allow_code: opt.AllowCode = False,
    device: opt.Device = "auto",
    with_report: opt.WithReport = False,
    run_dir: opt.RunDir = None,
) -> None:
    """Run agents in every cell of a grid of conditions.

    Finished cells are kept when it is interrupted; --resume continues."""
    from uuvtai.console.views import show_sweep
    from uuvtai.evaluation import sweep as sweeps
    from uuvtai.evaluation.grid import SweepRequest, grid_of

    parsing.refuse_less("--episodes", episodes, 1)
    engine, progress = place.made(), Progress("cells")
    if resume is not None:
        parsing.refuse_beside_resume(ctx, parsing.OF_A_SWEEP_RESUMED)
        result, folder = sweeps.resume(resume, engine, progress, allow_code)
    else:
        request = SweepRequest.typed(
            scene, agents.named(), grid=grid_of(grid or []), episodes=episodes,
            seeds=tuple(parsing.seeds("--seeds", seeds)), num_envs=num_envs, device=device,
        )  # fmt: skip
        result, folder = sweeps.sweep(request, engine, run_dir, progress)
    output.show(result, lambda screen: show_sweep(screen, result), folder)
    _report_if(with_report, folder, "uuv report")


@app.command("watch", epilog="Example: uuv watch --world gauntlet -D 9 --tanks 16 --open")
@groups.grouped
def watch_live(
    agents: groups.AgentsOrTreeGroup,
    scene: groups.SceneGroup,
    output: groups.PlainOutputGroup,
    episodes: opt.WatchEpisodes = 0,
    seeds: opt.Seeds = "0",
    rate: opt.Rate = 1.0,
    host: opt.Host = "127.0.0.1",
    port: opt.Port = 8765,
    origin: opt.Origins = None,
    tanks: opt.Tanks = 1,
    opens: opt.OpenPage = False,
    foxglove: opt.Foxglove = False,
    depth_images: opt.DepthImages = False,
) -> None:
    """Show episodes live in the browser, agents side by side, or in Foxglove."""
    seed_list = parsing.seeds("--seeds", seeds)
    parsing.refuse_less("--episodes", episodes, 0)
    parsing.refuse_odd_live(rate, port, tanks, len(agents.named()), foxglove)
    if (opens and foxglove) or (depth_images and not foxglove):
        raise UsageError("--open: is of the page; --depth-images: is of --foxglove")
    from uuvtai.console.views import show_watched
    from uuvtai.evaluation.results import Request
    from uuvtai.evaluation.simulate import LiveOptions, watch_episodes

    request = Request.typed(
        scene, agents.named(), seeds=seed_list, episodes=episodes, depth_images=depth_images, device="cpu"
    )
    live = LiveOptions(host, port, rate, origin or (), tanks, foxglove, opens)
    result = watch_episodes(request, live, Progress())
    output.show(result, lambda screen: show_watched(screen, result))


@app.command("drive", epilog="Example: uuv drive --world maze --agent bt,best --open")
@groups.grouped
def drive_vehicle(
    agents: groups.AgentsOrTreeGroup,
    scene: groups.SceneGroup,
    output: groups.PlainOutputGroup,
    episodes: opt.EvalEpisodes = 1,
    seeds: opt.Seeds = "0",
    port: opt.Port = 8765,
    opens: opt.OpenPage = False,
    run_dir: opt.RunDir = None,
) -> None:
    """Steer a vehicle in the browser; bt drives the same episode.

    By keys or a gamepad, and by what the vehicle senses. Log and report are those of 'uuv eval'."""
    seed_list = parsing.seeds("--seeds", seeds)
    parsing.refuse_less("--episodes", episodes, 1)
    parsing.refuse_odd_live(1.0, port)
    from uuvtai.console.views import show_evaluation
    from uuvtai.evaluation.results import Request
    from uuvtai.evaluation.simulate import LiveOptions, drive_by_hand

    request = Request.typed(
        scene, agents.named(), seeds=seed_list, episodes=episodes, device="cpu", run_dir=run_dir
    )
    result, folder, page = drive_by_hand(request, LiveOptions(port=port, opens=opens), Progress())
    output.show(result, lambda screen: show_evaluation(screen, result, folder), folder)
    say(f"report: {page}")


# ----------------------------------------------------------------------------------------------------- Learn


@app.command("train", epilog="Example: uuv train --run-dir runs/first")
@groups.grouped
def train_policy(
    ctx: typer.Context,
    scene: groups.TrainSceneGroup,
    output: groups.PlainOutputGroup,
    preset: opt.TrainPreset = "policy",
    resume: opt.TrainResume = None,
    iterations: opt.Iterations = None,
    start: opt.TrainStart = None,
    reward: opt.Reward = None,
    seed: opt.TrainSeed = None,
    device: opt.Device = "auto",
    with_report: opt.WithReport = False,
    run_dir: opt.RunDir = None,
) -> None:
    """Train a policy into a run folder.

    Ctrl-C saves a checkpoint; --resume continues."""
    from uuvtai.console.screen import TrainingProgress
    from uuvtai.console.views import show_training
    from uuvtai.evaluation.evaluate import evaluate_now
    from uuvtai.learning.runner import TrainRequest, train

    more: dict[str, Any] = {"iterations": iterations, "device": device, "reward": parsing.reward(reward)}
    if resume is None:
        config = scene.training(preset, [] if seed is None else [("train.seed", seed)])
        if scene.motion and config.surrogate.enabled:
            raise UsageError("--motion: needs a preset that trains in the simulator, such as ppo or paper")
        request = TrainRequest(config, preset, start=start, run_dir=run_dir, **more)
    else:
        parsing.refuse_beside_resume(ctx, ("iterations", "device", "overrides", "reward"))
        request = TrainRequest(resume=resume, overrides=[*(scene.overrides or [])], **more)
    result, folder = train(request, TrainingProgress(), evaluate_now)
    _report_if(with_report, folder)
    output.show(result, lambda screen: show_training(screen, result))


@app.command("export", epilog="Example: uuv export runs/mine --out runs/mine_export")
@groups.grouped
def export_policy(
    output: groups.PlainOutputGroup,
    run: opt.ExportRun = None,
    out: opt.ExportOut = None,
    evaluation: opt.ExportEvaluation = None,
    check: opt.ExportCheck = None,
    machines: opt.ExportFor = "x86_64,aarch64",
    force: opt.ExportForce = False,
) -> None:
    """Export a policy or a whole stack to run without uuvtai.

    A policy needs NumPy alone, or ONNX; the stack of a log becomes native code. Exit code 3: --check found
    that an exported policy disagrees."""
    from uuvtai.console.views import show_export, show_stack

    if (run is None) == (check is None):
        raise UsageError("give the RUN to export, or --check DIR for a folder that was exported")
    from uuvtai.evaluation.agents import export_log, export_run
    from uuvtai.learning.export import folder as export

    if run is not None and run.endswith(".mcap"):
        written = export_log(Path(run), out, machines.split(","))
        return output.show(written, lambda _: show_stack(written))
    found = export.check(check, say) if check else export_run(run or "", out, evaluation or [], say, force)
    output.show(found, lambda screen: show_export(screen, found, is_ours=check is None))
    if not found["agrees"]:
        raise typer.Exit(GATE)


# ------------------------------------------------------------------------------------------------------ Look


@app.command("report", epilog="Example: uuv report runs/first")
@groups.grouped
def report_run(
    runs: opt.ReportRuns,
    output: groups.PlainOutputGroup,
    out: opt.ReportOut = None,
    paper: opt.ReportPaper = None,
    open_page: opt.OpenPage = False,
    force: opt.Force = False,
) -> None:
    """Write the HTML page of a run, or figures for a paper.

    The page is one file with a player of recorded episodes, figures and tables."""
    if paper is not None:
        if out is not None or force or open_page:
            raise UsageError("--paper: writes a folder of its own; leave out --out, --open and --force")
        from uuvtai.report.paper import paper as write_paper

        kit = write_paper(runs, paper)
        return output.show(kit.document(), lambda _screen: typer.echo(str(kit.folder)))
    from uuvtai.report.build import report

    written = report(runs, out, force)
    document = {"schema": 1, "report": str(written.page), "figures": list(map(str, written.figures))}
    output.show(document, lambda _screen: typer.echo(str(written.page)))
    _open(written.page, open_page)


def _report_if(with_report: bool, folder: Path, otherwise: str = "", opens: bool = False) -> None:
    """Write the report and tell its place, or else what to type next."""
    if with_report:
        from uuvtai.report.build import report

        say(f"report: {(page := report([folder]).page)}")
        _open(page, opens)
    elif otherwise:
        say(f"next: {otherwise} {shlex.quote(str(folder))}")


def _open(page: Path, wanted: bool) -> None:
    import webbrowser

    if wanted and not webbrowser.open_new_tab(page.resolve().as_uri()):
        say(f"--open: no browser was found here; open {page} in one")


app.add_typer(log_app, name="log")


@app.command(epilog="Example: uuv presets show gauntlet")
@groups.grouped
def presets(
    output: groups.PlainOutputGroup,
    action: opt.PresetsAction = None,
    name: opt.PresetName = None,
    everything: opt.Everything = False,
    run: opt.TreeUse = None,
    dot: opt.Dot = False,
    out: opt.WorldPicture = None,
    force: opt.Force = False,
) -> None:
    """List the presets, or show one of them.

    A world is checked and drawn as well."""
    from uuvtai.console import views as shown

    if action is None:
        return output.show(shown.sentences(), shown.show_presets)
    kind, name = shown.kind_and_name(action, name, run)
    if (run is not None or dot) and kind != "tree":
        raise UsageError(f"--run, --dot: are of a tree, and {name} is a preset of kind {kind}")
    if out is not None:
        if kind != "world" or everything or output.as_json:
            raise UsageError("--out: is of the picture of a world, without --all and --json")
        refuse_output(out, [Path(name)], force)
    if kind == "tree" and not everything:
        from uuvtai.sim.behavior_tree import tree_report

        report = tree_report(name, run)
        return output.show(report.document, lambda screen: shown.show_tree_report(screen, report, dot))
    if not everything or kind == "tree":  # a tree has no keys
        return shown.show_stated(kind, name, output.as_json, out)
    from uuvtai.sim.scene import whole_preset

    found, text = whole_preset(kind, name)
    output.show(found, lambda _screen: typer.echo(text))


@app.command(epilog="Example: uuv doctor --compile --num-envs 64,256")
@groups.grouped
def doctor(output: groups.PlainOutputGroup, warmed: groups.CompileGroup, clean: opt.Clean = False) -> None:
    """Check the installation, or compile kernels in advance."""
    if not warmed.compile:
        signals.engage()
    from uuvtai.console import doctor as work

    if clean:
        typer.echo(f"deleted {work.clean()} files of machine code", err=True)
    if warmed.compile:
        shapes = warmed.made()
        return output.show({"shapes": shapes}, lambda screen: work.show_shapes(screen, shapes))
    found = work.checks()
    is_ok = all(check["ok"] for check in found)
    output.show({"ok": is_ok, "checks": found}, lambda screen: work.show_checks(screen, found))
    if not is_ok:
        raise typer.Exit(FAILED)


@app.command(epilog="Example: uuv examples mine")
def examples(folder: opt.ExamplesFolder = Path("examples")) -> None:
    """Copy the example files into a folder."""
    from uuvtai.console.doctor import copy_examples

    typer.echo("\n".join(map(str, copy_examples(folder))))


# ------------------------------------------------------------------------------------------------- Look: log


@log_app.command("info", epilog="Example: uuv log info runs/first/logs/bt_seed0_episode0.mcap")
@groups.grouped
def log_info(output: groups.PlainOutputGroup, file: opt.LogFile) -> None:
    """Topics, counts, rates, metadata and outcome of a log."""
    from uuvtai.console.views import show_log
    from uuvtai.logs import reader

    found = reader.info(file)
    output.show(found, lambda screen: show_log(screen, found, file))


@log_app.command("export", epilog="Example: uuv log export runs/first/logs/bt_seed0_episode0.mcap --out all")
def log_export(
    file: opt.LogFile, out: opt.LogExportOut, topic: opt.Topics = None, fmt: opt.LogFormat = "json"
) -> None:
    """Write every topic as a file, and the attachments below attachments/."""
    from uuvtai.logs import export as log_export

    for path in log_export.export(file, out, topic, fmt):
        typer.echo(str(path))


@log_app.command("convert", epilog="Example: uuv log convert runs/first/logs/bt_seed0_episode0.mcap")
def log_convert(file: opt.LogFile, out: opt.ConvertOut = None) -> None:
    """Write a log as a ROS 2 bag."""
    from uuvtai.logs.rosbag import to_rosbag2

    target = out or file.with_name(f"{file.stem}_rosbag2")
    typer.echo(f"{target}: {to_rosbag2(file, target)} messages")


@log_app.command("import", epilog="Example: uuv log import dive.tlog dvl.jsonl sonar.bin --sensors ping360")
@groups.grouped
def log_import(
    file: opt.Recordings,
    output: groups.PlainOutputGroup,
    sensors: opt.ImportSensors = None,
    world: opt.ImportWorld = "open",
    start: opt.ImportStart = None,
    goal: opt.ImportGoal = None,
    offset: opt.ImportOffsets = None,
    out: opt.ImportOut = None,
) -> None:
    """Make one log of recordings of a vehicle and its instruments."""
    from uuvtai.console.vehicle_views import show_import
    from uuvtai.vehicle.recordings.combine import ImportPlan, import_recordings

    place = parsing.numbers("--start", start, 4 if (start or "").count(",") == 3 else 3)
    target = out or file[0].with_name(f"{file[0].stem}.log.mcap")
    plan = ImportPlan(file, target, world, sensors, place, parsing.numbers("--goal", goal, 3), offset or ())
    found = import_recordings(plan)
    output.show(found, lambda screen: show_import(screen, found))


@log_app.command(
    "render", epilog="Example: uuv log render runs/first/logs/bt_seed0_episode0.mcap --out a.mp4"
)
def log_render(
    file: opt.RenderLogs,
    out: opt.RenderOut = None,
    clearance: opt.WithClearance = False,
    speed: opt.VideoSpeed = None,
    fps: opt.VideoFps = None,
    width: opt.RenderWidth = None,
    force: opt.LogForce = False,
) -> None:
    """Draw a picture (PNG) or a video (MP4, GIF) of an episode."""
    from uuvtai.common.files import output_beside

    target = output_beside(file, out, ".png", force)
    if target.suffix.lower() == ".png":
        if speed is not None or fps is not None:
            raise UsageError("--speed, --fps: are of a video; add --out NAME.mp4")
        from uuvtai.logs.picture import picture

        more: dict[str, Any] = {} if width is None else {"width_px": width}
        picture(file, target, clearance=clearance, **more)
    else:
        if clearance or len(file) > 1:
            raise UsageError("--clearance and several logs: are of a picture; give --out NAME.png")
        from uuvtai.logs.video import video

        with counted(target.name, "frames") as drawn:
            video(file[0], target, width, fps, 1.0 if speed is None else speed, drawn)
    typer.echo(str(target))


@log_app.command("repair", epilog="Example: uuv log repair runs/first/logs/bt_seed0_episode0.mcap")
def log_repair(file: opt.LogFile, out: opt.RepairOut = None, force: opt.LogForce = False) -> None:
    """Recover the messages of a log whose writing was cut off."""
    from uuvtai.logs import export as repair

    found = repair.repair(file, out, force)
    for damage in found.damages:
        say(damage)
    typer.echo(f"{found.path}: {found.messages} messages recovered, the last at {found.last_time_s:.2f} s")


# ----------------------------------------------------------------------------------------------------- Paper


@app.command(epilog="Example: uuv reproduce --budget quick --run-dir runs/reproduction")
@groups.grouped
def reproduce(
    ctx: typer.Context,
    own: groups.PluginsGroup,
    output: groups.PlainOutputGroup,
    budget: opt.BudgetName = "quick",
    allow_code: opt.AllowCode = False,
    resume: opt.ReproduceResume = None,
    run_dir: opt.RunDir = None,
) -> None:
    """Repeat the paper's experiments and judge each claim."""
    from uuvtai.evaluation import reproduce as paper_run
    from uuvtai.report.reproduction import claim_table

    if resume is not None:
        parsing.refuse_beside_resume(ctx, ("budget", "allow_code"))
        result, folder = paper_run.resume(resume, Progress(), allow_code)
    else:
        result, folder = paper_run.reproduce(budget, run_dir, Progress(), own.named())
    output.show(result, lambda screen: screen.table(claim_table(result)), folder)


@app.command(epilog="Example: uuv profile --num-envs 1,64 --seconds 5")
@groups.grouped
def profile(
    scene: groups.ProfileSceneGroup,
    output: groups.OutputGroup,
    num_envs: opt.BatchSizes = "1,64,1024",
    agent: opt.TickedTree = "bt",
    preset: opt.ProfilePreset = "paper",
    seconds: opt.ProfileSeconds = 10.0,
    density: opt.Density = False,
    device: opt.Device = "auto",
) -> None:
    """Measure speed and memory, and the paper's timing tables."""
    sizes = parsing.integers("--num-envs", num_envs)
    parsing.refuse_no_duration("--seconds", seconds)
    from uuvtai.console.views import show_profile
    from uuvtai.evaluation.profile import profile as run

    result = run(scene.training(preset), sizes, agent, device, seconds, density, say)
    output.show(result, lambda screen: show_profile(screen, result))


# --------------------------------------------------------------------------------------------------- Vehicle


@app.command(
    "pilot", epilog="Example: uuv pilot --mavlink udp:127.0.0.1:14550 --start 2,3,-0.8 --goal 18,3,-0.8"
)
@groups.grouped
def pilot_vehicle(
    flight: groups.FlightGroup,
    scene: groups.SeenSceneGroup,
    output: groups.PlainOutputGroup,
    agent: opt.PilotTree = "bt",
) -> None:
    """Drive a vehicle over MAVLink; a dry run without --arm.

    Read docs/safety.md first. Exit code 3: it ended by a safe action, or failed --check or --calibrate."""
    from uuvtai.console.vehicle_views import show_flight
    from uuvtai.sim.behavior_tree import read_tree
    from uuvtai.vehicle.calibrate import write_rig
    from uuvtai.vehicle.control_loop import fly

    config = scene.config()
    found, failure = fly(config, read_tree(agent), flight.plan(config), say)
    output.show(found, lambda screen: show_flight(screen, found))
    if failure is not None:
        raise failure
    if flight.calibrate and found["calibration"]["rig"]:
        write_rig(flight.calibrate, scene.sensors, found["calibration"])
        say(f"wrote {flight.calibrate}")
    if found["interrupted"]:
        raise typer.Exit(signals.exit_code())
    if not found["safe"] or not found["ready"]:
        raise typer.Exit(GATE)


@app.command("sitl", epilog="Example: uuv sitl --sensors ping360 --as a50,ping360,autopilot --operator")
@groups.grouped
def serve_sitl(
    scene: groups.SitlSceneGroup, served: groups.ServedGroup, output: groups.PlainOutputGroup
) -> None:
    """Be ArduSub's water, or a whole vehicle for uuv pilot.

    ArduSub connects by its JSON interface; --as autopilot stands in for it (docs/on_a_vehicle.md)."""
    from uuvtai.console.vehicle_views import show_sitl
    from uuvtai.sim.behavior_tree import read_tree
    from uuvtai.vehicle.sitl import serve_water

    plan, config = served.plan(), scene.config()
    found = serve_water(config, read_tree("straight"), plan, say)
    output.show(found, lambda screen: show_sitl(screen, found))


@app.command("identify", epilog="Example: uuv identify drive.csv --vehicle bluerov2_16v --out mine.yaml")
@groups.grouped
def identify_vehicle(
    file: opt.DriveLogs,
    output: groups.PlainOutputGroup,
    vehicle: opt.BaseVehicle = "bluerov2_16v",
    known: opt.IdentifyKnown = "gain",
    truth: opt.IdentifyTruth = False,
    out: opt.IdentifyOut = None,
    overrides: opt.Set = None,
    system: opt.IdentifySystem = None,
    force: opt.Force = False,
) -> None:
    """Estimate a vehicle's parameters from logs of drives.

    Drag, added mass, buoyancy, thruster gain and rotor lag, with confidence intervals."""
    from uuvtai.vehicle.identify.fit import identify

    target = out or file[0].with_suffix(".vehicle.yaml")
    base = SceneOptions("open", "clean", vehicle, overrides=overrides).config().vehicle
    document = identify(file, base, vehicle, known, truth, target, force, system)

    from uuvtai.console.vehicle_views import show_identified

    output.show(document, lambda screen: show_identified(screen, document, f"{known} of {vehicle}"))
    say(f"wrote {target}")


@app.command("replay", epilog="Example: uuv replay runs/first/logs/bt_seed0_episode0.mcap --lose dvl:10:15")
@groups.grouped
def replay_log(
    faults: groups.FaultsGroup,
    log: opt.ReplayLog,
    output: groups.PlainOutputGroup,
    agent: opt.ReplayTree = None,
    is_open: opt.ReplayOpen = False,
) -> None:
    """Run the stack on a log's sensor data; compare commands.

    Exit code 3: the commands differ although no fault was added."""
    from uuvtai.console.vehicle_views import show_opened, show_replay
    from uuvtai.vehicle.replay import open_replay, replay

    if is_open:
        opened, folder = open_replay(log, faults.made(), agent)
        _report_if(True, folder)
        return output.show(opened, lambda screen: show_opened(screen, opened), folder)
    found = replay(log, faults.made(), agent)
    output.show(found, lambda screen: show_replay(screen, found))
    if not (found["equal"] or found["faults"]["any"]):
        raise typer.Exit(GATE)


@app.command(epilog="Example: uuv simulate --seconds 5 --wrench 10,0,0,0,0,0 --vehicle bluerov2_heavy")
@groups.grouped
def simulate(
    motion: groups.MotionGroup,
    agent: groups.AgentGroup,
    output: groups.PlainOutputGroup,
    vehicle: opt.BaseVehicle = "bluerov2",
    overrides: opt.Set = None,
) -> None:
    """Simulate one vehicle in open water, open loop.

    With --agent it is driven to a goal instead."""
    config = SceneOptions("open", "clean", vehicle, overrides=overrides).config()
    from uuvtai.console.views import show_simulation
    from uuvtai.evaluation.simulate import simulate as run

    trial, driven = motion.trial(), agent.one
    if driven is None:
        result = run(config, trial)
    else:
        from uuvtai.evaluation.simulate import drive

        result = drive(config, trial, driven)
    title = f"{vehicle}: {trial.seconds:g} s, substep {trial.dt:g} s"
    output.show(result, lambda screen: show_simulation(screen, result, title, driven))


# --------------------------------------------------------------------------------------------- the program


@app.callback(invoke_without_command=True)
def _root(
    ctx: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit
    if ctx.invoked_subcommand in ("report", "export", "log"):
        signals.engage()  # the others have nothing to tidy up before they have a run folder
    # building kernels makes millions of objects, few of them garbage: half a second of a start
    gc.set_threshold(50_000, 50, 1000)


def main(arguments: list[str] | None = None) -> None:
    """Run a command and leave with its exit code. ``uuv`` itself begins in ``uuvtai.__main__``."""
    code = guarded(lambda: parsing.telling_new_names(app, arguments))
    signals.finish(code)
    sys.exit(code)


if __name__ == "__main__":
    main()
