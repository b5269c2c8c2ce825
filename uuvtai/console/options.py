"""What may be typed after a command of ``uuv``: each argument and option once, with help and completion.

Options of ``_more`` stand in the second panel of a command's help.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from uuvtai.console import parsing

_WORLDS, _SENSORS, _VEHICLES = (parsing.names(kind) for kind in ("world", "sensors", "vehicle"))
_NAME = "NAME|FILE"
_PANEL: dict[str, Any] = {"rich_help_panel": "More"}
_more = functools.partial(Option, rich_help_panel="More")


def _preset(option: str, kind: str, help_text: str, **shown: Any) -> Any:
    return Option(option, metavar=_NAME, help=help_text, autocompletion=parsing.presets(kind), **shown)


def _tree(help_text: str, **shown: Any) -> Any:
    complete = parsing.presets("tree", suffix=".xml")
    text = f"{help_text}: {parsing.names('tree')}, or an XML file."
    return Option("--agent", metavar=_NAME, help=text, autocompletion=complete, **shown)


def _agents(help_text: str) -> Any:
    return Option("--agent", metavar=_NAME, help=help_text, autocompletion=parsing.agent_names)


def _run(help_text: str, name: str = "--resume") -> Any:
    return Option(name, metavar="RUN", help=help_text, autocompletion=parsing.runs("run.json"))


def _out(help_text: str) -> Any:
    return Option("--out", help=help_text)


# ------------------------------------------------------------------------------------------------ of several

World = Annotated[str, _preset("--world", "world", f"World: {_WORLDS}, or a YAML file.")]
Sensors = Annotated[
    str | None,
    _preset(
        "--sensors",
        "sensors",
        f"Sensors: {_SENSORS}, or a YAML file \\[default: the world's, or paper].",
        **_PANEL,
    ),
]
Vehicle = Annotated[
    str | None,
    _preset(
        "--vehicle",
        "vehicle",
        f"Vehicle: {_VEHICLES}, or a YAML file \\[default: the world's, or bluerov2].",
        **_PANEL,
    ),
]
Static = Annotated[int | None, Option("--static", "-S", help="Number of static obstacles.")]
Dynamic = Annotated[int | None, Option("--dynamic", "-D", help="Number of moving obstacles.")]
Speed = Annotated[float | None, Option("--speed", help="Speed of the moving obstacles \\[m/s].")]
Set = Annotated[
    list[str] | None, _more("--set", metavar="KEY=VALUE", help="Override a config key (repeatable).")
]
Motion = Annotated[
    str | None,
    _more("--motion", metavar="FILE.py:NAME", help="Moving obstacles that a function of yours gives."),
]
_MEANT = {"gpu": "cuda", "nvidia": "cuda"}  # what people type for a device, and what they mean by it
_WHERE = "Where to compute; auto takes a GPU if there is one."
Device = Annotated[str, parsing.choice("--device", ("auto", "cpu", "cuda"), _WHERE, _MEANT, **_PANEL)]
OpenPage = Annotated[bool, Option("--open", help="Open the page in the browser.")]
RunDir = Annotated[Path | None, Option("--run-dir", help="Run folder \\[default: runs/TIME_PRESET].")]
WithReport = Annotated[bool, Option("--report", help="Also write report.html into the run folder.")]
Wide = Annotated[bool, _more("--wide", help="Show all columns even if they do not fit the terminal.")]
AsJson = Annotated[bool, _more("--json", help="Print one JSON document and nothing else on stdout.")]
Seeds = Annotated[str, Option("--seeds", "--seed", help="Seeds, separated by commas.")]
Batch = Annotated[int | None, _more("--num-envs", help="Episodes in parallel \\[default: chosen for you].")]
AllowCode = Annotated[
    bool, _more("--allow-code", help="With --resume: run the Python files that the run folder names.")
]
DepthImages = Annotated[
    bool, _more("--depth-images", help="Also record the depth camera; 'uuv replay' needs it.")
]

# ----------------------------------------------------------------------------------------- eval, sweep, watch

_KINDS = "a preset, a tree's .xml, mine.py:act, mine.py:load, model.onnx, a run folder (repeatable)"
Agents = Annotated[
    list[str] | None,
    _agents(
        f"Who drives: bt, best, policy, bt+truth, oracle ..; {_KINDS} \\[default: straight, planner, bt]."
    ),
]
AgentsOrTree = Annotated[list[str] | None, _agents(f"Who drives: {_KINDS} \\[default: bt].")]
Planners = Annotated[
    list[str] | None,
    _more(
        "--planner",
        metavar="FILE.py:NAME",
        help="A route planner of yours in place of the built-in one; bt follows its routes (repeatable).",
        autocompletion=parsing.files(".py"),
    ),
]
EvalEpisodes = Annotated[int, Option("--episodes", help="Episodes per seed.")]
Record = Annotated[int, Option("--record", help="Record the first K episodes of every agent as MCAP.")]
Explain = Annotated[bool, Option("--explain", help="Find the cause of every failure, from the ground truth.")]
ExplainRecord = Annotated[
    int | None,
    _more("--explain-record", help="With --explain: record N of an agent's worst failures \\[default: 3]."),
]
EvalResume = Annotated[Path | None, _run("Continue an interrupted evaluation.")]
GridAxes = Annotated[
    list[str] | None,
    Option(
        "--grid",
        metavar="NAME|AXIS=VALUES",
        help="AXIS=value,value,.. (repeatable: S, D, v, sensors, vehicle, any config key) or a preset: "
        f"{parsing.names('grid')} \\[default: paper].",
        autocompletion=parsing.grids,
    ),
]
SweepEpisodes = Annotated[int, Option("--episodes", help="Episodes per seed, cell and agent.")]
EngineName = Annotated[
    str,
    parsing.choice("--engine", ("local", "ray"), "Processes on this machine, or a Ray cluster.", **_PANEL),
]
Workers = Annotated[int, Option("--workers", help="Processes of the local engine.")]
Address = Annotated[str, _more("--address", help="Ray cluster: host:port, auto, or local (this process).")]
SweepResume = Annotated[Path | None, _run("Continue an interrupted sweep.")]
Tanks = Annotated[int, Option("--tanks", help="Episodes at once, side by side: 1 to 16.")]
Foxglove = Annotated[bool, Option("--foxglove", help="Serve Foxglove and Lichtblick in place of a page.")]
WatchEpisodes = Annotated[int, Option("--episodes", help="Episodes per seed; 0 = until Ctrl-C.")]
Rate = Annotated[float, Option("--rate", help="Episode seconds per second; 0 = as fast as possible.")]
Host = Annotated[str, _more("--host", help="Address to serve at; 0.0.0.0 = to the whole network.")]
Port = Annotated[int, Option("--port", help="Port to serve at; 0 = a free one.")]
Origins = Annotated[
    list[str] | None,
    _more(
        "--origin",
        metavar="URL",
        help="Web page that may connect, as https://app.foxglove.dev; or an address of ours (repeatable).",
    ),
]

# -------------------------------------------------------------------------------------------- train, export

TrainPreset = Annotated[
    str,
    Argument(
        metavar="PRESET",
        help=f"What to train ('uuv presets' tells): {parsing.names('train')}, or a YAML file.",
        autocompletion=parsing.presets("train"),
    ),
]
TrainResume = Annotated[Path | None, _run("Continue this training; repeat its --reward and --iterations.")]
Iterations = Annotated[
    int | None, Option("--iterations", help="Total iterations. Schedules still span train.iterations.")
]
TrainStart = Annotated[
    Path | None, _run("Run whose policy to begin with, or policy: the built-in one.", "--start")
]
Reward = Annotated[
    str | None,
    Option("--reward", metavar="FILE.py:NAME", help="Terms of yours beside the built-in ones (ppo, paper)."),
]
TrainSeed = Annotated[int | None, Option("--seed", help="Random seed (train.seed).")]
TrainWorld = Annotated[
    str | None, _preset("--world", "world", f"World: {_WORLDS}, or a YAML file \\[default: the preset's].")
]
TrainSensors = Annotated[
    str | None,
    _preset(
        "--sensors", "sensors", f"Sensors: {_SENSORS}, or a YAML file \\[default: the preset's].", **_PANEL
    ),
]
ExportRun = Annotated[
    str | None,
    Argument(
        metavar="[RUN]",
        help="Run folder or checkpoint; or a log (.mcap), to export the whole stack that drove.",
        autocompletion=parsing.runs("checkpoints"),
    ),
]
ExportOut = Annotated[Path | None, _out("New folder \\[default: runs/NAME_export].")]
ExportEvaluation = Annotated[
    list[Path] | None,
    Option("--evaluation", metavar="RUN", help="Evaluation to quote in the model card (repeatable)."),
]
ExportCheck = Annotated[Path | None, Option("--check", help="Check this exported folder instead.")]
ExportForce = Annotated[bool, Option("--force", help="Replace the exported policy that --out names.")]
ExportFor = Annotated[
    str, Option("--for", help="Processors that a stack is compiled for, separated by commas.")
]

# ------------------------------------------------------------------------------ report, presets, doctor, log

ReportRuns = Annotated[list[Path], Argument(metavar="RUN", help="Run folders; several make one page.")]
ReportOut = Annotated[Path | None, _out("The page \\[default: RUN/report.html].")]
ReportPaper = Annotated[
    Path | None,
    Option("--paper", help="New folder for figures (PDF, SVG), tables (LaTeX, CSV) and captions of a paper."),
]
Force = Annotated[bool, Option("--force", help="Replace files that are there.")]
PresetsAction = Annotated[
    str | None, Argument(metavar="show", help="'show' prints one preset.", autocompletion=lambda: ["show"])
]
PresetName = Annotated[
    str | None,
    Argument(
        metavar="NAME",
        help="Preset or file; KIND/NAME where two kinds share a name.",
        autocompletion=parsing.shown,
    ),
]
Everything = Annotated[
    bool, Option("--all", help="Every key with its value, defaults included; of a tree, its XML.")
]
TreeUse = Annotated[
    Path | None,
    Option(
        "--run",
        metavar="RUN",
        help="Of a tree: how often its nodes ran in this evaluation.",
        autocompletion=parsing.runs("eval/tree.json"),
    ),
]
WorldPicture = Annotated[
    Path | None, _out("Of a world: its picture, .png \\[default: beside a YAML file, .world.png].")
]
Dot = Annotated[bool, Option("--dot", help="Of a tree: print Graphviz DOT.")]
ExamplesFolder = Annotated[Path, Argument(metavar="FOLDER", help="Where to; what is there is kept.")]
Clean = Annotated[bool, Option("--clean", help="First delete our compiled kernels.")]
Compile = Annotated[
    bool, Option("--compile", help="Compile kernels now, so that later commands start at once.")
]
BatchSizes = Annotated[str, Option("--num-envs", help="Batch sizes, separated by commas.")]
WarmSensors = Annotated[str, Option("--sensors", help=f"Sensors, separated by commas: {_SENSORS}.")]
WarmWorkers = Annotated[int, Option("--workers", help="Processes; 0 = one per core.")]
LogFile = Annotated[Path, Argument(help="An .mcap file.")]
LogForce = Annotated[bool, Option("--force", help="Replace the file that --out names.")]
LogExportOut = Annotated[Path, _out("New or empty folder.")]
Topics = Annotated[list[str] | None, Option("--topic", help="Only this topic (repeatable).")]
LogFormat = Annotated[
    str, parsing.choice("--format", ("json", "csv", "npz"), "JSON (a line a message), CSV or NumPy arrays.")
]
RepairOut = Annotated[Path | None, _out("Repaired file \\[default: NAME.repaired.mcap].")]
ConvertOut = Annotated[Path | None, _out("New folder \\[default: NAME_rosbag2].")]
Recordings = Annotated[
    list[Path],
    Argument(
        metavar="FILE", help="ArduSub's .tlog, .BIN; lines of a DVL A50; Ping Viewer's file; a ROS bag."
    ),
]
ImportWorld = Annotated[str, _preset("--world", "world", f"World whose walls are known: {_WORLDS}, or YAML.")]
_MOUNTED = f"How sonar and DVL are mounted: {_SENSORS}, or YAML \\[default: a Ping360, else multibeam]."
ImportSensors = Annotated[str | None, _preset("--sensors", "sensors", _MOUNTED)]
_AT_FIRST = "Where the vehicle is at first \\[m, deg] \\[default: the tank's middle, along x]."
ImportStart = Annotated[str | None, Option("--start", metavar="X,Y,Z[,YAW]", help=_AT_FIRST)]
_GO = "Where the stack is to go \\[default: 5 m ahead]."
ImportGoal = Annotated[str | None, Option("--goal", metavar="X,Y,Z", help=_GO)]
_ADD = "Add to a file's times where its clock differs (repeatable)."
ImportOffsets = Annotated[list[str] | None, Option("--offset", metavar="FILE=SECONDS", help=_ADD)]
ImportOut = Annotated[Path | None, _out("New log \\[default: the first file's name, .log.mcap].")]
RenderLogs = Annotated[
    list[Path], Argument(metavar="FILE", help="Logs of one episode; a picture shows all trajectories.")
]
RenderOut = Annotated[
    Path | None, _out("Picture .png, or video .mp4 or .gif \\[default: the first log's name, .png].")
]
WithClearance = Annotated[bool, Option("--clearance", help="Of a picture: colour the clearance field.")]
VideoSpeed = Annotated[float | None, Option("--speed", help="Of a video: times real time \\[default: 1].")]
VideoFps = Annotated[
    float | None, Option("--fps", help="Of a video: frames per second \\[default: 15, GIF 10].")
]
RenderWidth = Annotated[
    int | None, Option("--width", help="Width \\[px] \\[default: picture 1600, video 1280, GIF 800].")
]

# ----------------------------------------------------------------------------------------- profile, reproduce

TickedTree = Annotated[str, _tree("Tree that drives")]
ProfilePreset = Annotated[
    str, _preset("--preset", "train", f"Training preset to time: {parsing.names('train')}, or a YAML file.")
]
ProfileSeconds = Annotated[float, Option("--seconds", help="Measured time per batch size \\[s].")]
Density = Annotated[bool, Option("--density", help="Also loop time against the number of obstacles.")]
BudgetName = Annotated[
    str,
    parsing.choice(
        "--budget",
        ("quick", "paper", "tenfold"),
        "A tenth of the paper's env-steps, all of them, or ten times as many.",
    ),
]
OwnAgents = Annotated[
    list[str] | None,
    Option(
        "--agent",
        metavar="FILE",
        help="An agent of yours beside ours in every table: mine.py:act, mine.py:load, model.onnx "
        "(repeatable).",
        autocompletion=parsing.files(".py", ".onnx"),
    ),
]
ReproduceResume = Annotated[Path | None, _run("Continue an interrupted reproduction.")]

# ------------------------------------------------------------------------------------------------ pilot, sitl

Mavlink = Annotated[
    str,
    Option(
        "--mavlink",
        metavar="udp:HOST:PORT",
        help="MAVLink of the vehicle: udp:HOST:PORT listens there, udpout:HOST:PORT speaks first.",
    ),
]
DvlPlace = Annotated[
    str | None,
    Option(
        "--dvl",
        metavar="KIND:HOST",
        help="Hear the DVL itself: a50:HOST, or json::14700 (UDP); MAVLink's then counts no more "
        "\\[default: sensors.dvl.at].",
    ),
]
SonarPlace = Annotated[
    str | None,
    Option(
        "--sonar",
        metavar="KIND:HOST",
        help="Hear the sonar itself: ping360:HOST, ping360:/dev/ttyUSB0, 3d15:224.0.0.96 or json::14700 "
        "\\[default: sensors.sonar.at].",
    ),
]
PilotStart = Annotated[str, Option("--start", metavar="X,Y,Z", help="Where the vehicle is now \\[m], z up.")]
PilotGoal = Annotated[str, Option("--goal", metavar="X,Y,Z", help="Where to drive to \\[m].")]
Heading = Annotated[
    float | None,
    Option(
        "--heading",
        help="Compass heading of the x axis \\[deg] \\[default: world.tank.heading_deg, or where it looks "
        "first].",
    ),
]
Arm = Annotated[bool, Option("--arm", help="Arm and drive; without it, a dry run.")]
PilotCheck = Annotated[
    bool, Option("--check", help="Judge what is heard of a vehicle at rest, and leave; it never arms.")
]
PilotCalibrate = Annotated[
    Path | None,
    Option(
        "--calibrate",
        metavar="FILE",
        help="Find out how the DVL is mounted and how the tank lies, while you drive by hand; write it as a "
        "file for --sensors. It never arms.",
    ),
]
FenceBox = Annotated[
    str | None,
    Option(
        "--box", metavar="X,Y,X,Y", help="Fence: smallest x, y, largest x, y \\[m] \\[default: the tank]."
    ),
]
FenceDepth = Annotated[
    str | None,
    Option(
        "--depth", metavar="MIN,MAX", help="Fence: depths \\[m] \\[default: the hull 1 cm within the tank]."
    ),
]
MostSpeed = Annotated[float, Option("--max-speed", help="Highest horizontal speed \\[m/s].")]
LeastBattery = Annotated[float, _more("--battery", help="Surface below this voltage \\[V].")]
VehicleId = Annotated[int, _more("--system", min=1, max=255, help="MAVLink id of the vehicle.")]
OperatorId = Annotated[
    int,
    _more("--operator", min=1, max=255, help="MAVLink id of the ground station; its heartbeat must come."),
]
HeardSenders = Annotated[
    list[str] | None,
    _more(
        "--sender",
        metavar="KIND=SYSTEM/COMPONENT",
        help="Accept attitude, imu, pressure, position, battery, dvl or sonar from this sender alone, for "
        "example dvl=255/0 or sonar=1/* (repeatable).",
    ),
]
PilotSeconds = Annotated[
    float | None,
    Option(
        "--seconds",
        help="Give the vehicle back after this time \\[s] \\[default: never; a check ends after 30, a "
        "calibration after 1200].",
    ),
]
PilotLog = Annotated[Path | None, _more("--log", help="Log to write \\[default: runs/pilot_TIME.mcap].")]
PilotForce = Annotated[bool, _more("--force", help="Replace the log that --log names.")]
PilotTree = Annotated[str, _tree("Who drives")]
PilotRate = Annotated[
    float,
    _more(
        "--rate",
        help="Vehicle seconds per second: 1 but for a simulated vehicle; 0 = follow the vehicle's clock.",
    ),
]
SeenSensors = Annotated[
    str, _preset("--sensors", "sensors", f"Sensors: {_SENSORS}, or a YAML file.", **_PANEL)
]
SitlPort = Annotated[int, _more("--port", min=1, max=65535, help="UDP port of the first ArduSub's physics.")]
SitlHost = Annotated[str, _more("--host", help="Address to listen at.")]
Instances = Annotated[
    int, Option("--instances", help="ArduSubs (their -I 0, 1, ..); ports count on by ten, episodes by one.")
]
SensorPlaces = Annotated[
    list[str] | None,
    _more(
        "--mavlink",
        metavar="udp:HOST:PORT",
        help="Where DVL, sonar and altimeter messages go (repeatable) \\[default: udp:127.0.0.1:14660 for "
        "ArduSub, udpout:127.0.0.1:14550 for uuv pilot].",
    ),
]
Emulated = Annotated[
    str | None,
    Option(
        "--as",
        metavar="a50,ping360",
        help="Be these instruments (a50, ping360, 3d15, json; KIND:PORT), by their own protocols, in place "
        "of MAVLink's DVL and sonar; autopilot: a small one in ArduSub's place.",
    ),
]
PlayOperator = Annotated[
    bool, Option("--operator", help="Be the ground station too: heartbeat and ArduSub's origin.")
]
SitlRate = Annotated[
    float, _more("--rate", help="Simulated seconds per second, at most; 0 = as ArduSub asks.")
]
SitlSeconds = Annotated[
    float | None, Option("--seconds", help="End after this time \\[s] \\[default: at Ctrl-C].")
]
SitlOnce = Annotated[bool, Option("--once", help="End when the episode of every instance has ended.")]
SitlSeed = Annotated[int, Option("--seed", help="Seed of the episodes.")]
SitlEpisode = Annotated[int, _more("--episode", min=0, help="Episode of the first instance.")]

# --------------------------------------------------------------------------------- identify, replay, simulate

DriveLogs = Annotated[
    list[Path],
    Argument(
        metavar="FILE",
        help="Logs: our .mcap, ArduSub's .bin or .tlog, or .csv with t,u,v,w,r,rpm_1,.."
        " (docs/on_a_vehicle.md).",
    ),
]
BaseVehicle = Annotated[str, _preset("--vehicle", "vehicle", f"Vehicle: {_VEHICLES}, or a YAML file.")]
IdentifyKnown = Annotated[
    str,
    parsing.choice(
        "--known",
        ("gain", "added-mass", "buoyancy"),
        "What is taken from --vehicle: speeds and rotor speeds alone give ratios.",
    ),
]
IdentifySystem = Annotated[
    int | None,
    Option(
        "--system",
        min=1,
        max=255,
        help="MAVLink id in a .tlog of several vehicles \\[default: most motor data].",
    ),
]
IdentifyTruth = Annotated[
    bool, Option("--truth", help="Of a simulated log: take the true motion, not the instruments.")
]
IdentifyOut = Annotated[
    Path | None, _out("Vehicle file, with a .png of the prediction \\[default: NAME.vehicle.yaml].")
]
ReplayLog = Annotated[Path, Argument(help="A log of 'uuv eval --record N --depth-images', 'uuv log import'.")]
_OPENED = "Compare nothing: what the stack perceives and would command, as log, picture and report."
ReplayOpen = Annotated[bool, Option("--open", help=_OPENED)]
ReplayTree = Annotated[str | None, _tree("Tree in place of the log's own")]
Drop = Annotated[float, Option("--drop", help="Share of the sensor messages to lose, 0 to 1.")]
Jitter = Annotated[float, Option("--jitter", help="Delay messages by up to this time \\[s].")]
Lose = Annotated[
    list[str] | None,
    Option(
        "--lose",
        metavar="SENSOR:FROM:TO",
        help="Switch off imu, dvl, pressure, position, sonar or depth for a while \\[s] (repeatable).",
    ),
]
FaultSeed = Annotated[int, Option("--fault-seed", help="Seed of --drop and --jitter.")]
SimulateSeconds = Annotated[float, Option("--seconds", help="Duration \\[s].")]
SimulateAgent = Annotated[
    str | None, _agents("Who drives from rest to the goal of world open: bt, another tree, or mine.py:act.")
]
Wrench = Annotated[str | None, Option("--wrench", help="Constant body wrench fx,fy,fz,mx,my,mz [N, N m].")]
Command = Annotated[
    str | None, Option("--command", help="Body velocity command u,v,w,r \\[m/s, rad/s] for the inner loop.")
]
Current = Annotated[str | None, Option("--current", help="Water velocity x,y,z \\[m/s].")]
InitialRpy = Annotated[str | None, _more("--initial-rpy-deg", help="Roll, pitch, yaw \\[deg].")]
InitialVelocity = Annotated[str | None, _more("--initial-velocity", help="u,v,w,p,q,r \\[m/s, rad/s].")]
Neutral = Annotated[bool, _more("--neutral", help="Buoyancy equal to weight.")]
Substep = Annotated[float, _more("--dt", help="Dynamics substep \\[s].")]
