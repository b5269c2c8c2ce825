"""What may be typed after a command of ``uuv``: each argument and option once, with help and completion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from uuvtai.console import parsing

_WORLDS, _SENSORS, _VEHICLES = (parsing.names(kind) for kind in ("world", "sensors", "vehicle"))
_NAME = "NAME|FILE"


def _preset(option: str, kind: str, help_text: str) -> Any:
    return Option(option, metavar=_NAME, help=help_text, autocompletion=parsing.presets(kind))


def _tree(help_text: str) -> Any:
    complete = parsing.presets("tree", suffix=".xml")
    text = f"{help_text}: {parsing.names('tree')}, or an XML file."
    return Option("--controller", metavar=_NAME, help=text, autocompletion=complete)


def _resume(help_text: str) -> Any:
    return Option("--resume", help=help_text, autocompletion=parsing.runs)


def _players(metavar: str, help_text: str) -> Any:
    return Argument(metavar=metavar, help=help_text, autocompletion=parsing.policies)


def _controllers(help_text: str) -> Any:
    return Option("--controller", metavar=_NAME, help=help_text, autocompletion=parsing.controller_choices)


# ------------------------------------------------------------------------------------------------ of several

World = Annotated[str, _preset("--world", "world", f"World: {_WORLDS}, or a YAML file.")]
Sensors = Annotated[
    str | None,
    _preset(
        "--sensors",
        "sensors",
        f"Sensors: {_SENSORS}, or a YAML file \\[default: the world's own, else paper].",
    ),
]
Vehicle = Annotated[
    str | None,
    _preset(
        "--vehicle",
        "vehicle",
        f"Vehicle: {_VEHICLES}, or a YAML file \\[default: the world's own, else bluerov2].",
    ),
]
Static = Annotated[int | None, Option("-S", help="Static obstacles.")]
Dynamic = Annotated[int | None, Option("-D", help="Moving obstacles.")]
Speed = Annotated[float | None, Option("-v", help="Speed of the moving obstacles \\[m/s].")]
Stack = Annotated[
    str | None,
    _preset(
        "--stack",
        "stack",
        f"How the classical half works: {parsing.names('stack')} (as in the paper), or a YAML file "
        "\\[default: ours].",
    ),
]
Set = Annotated[
    list[str] | None,
    Option("--set", metavar="KEY=VALUE", help="Override a config key: key.sub=value (repeatable)."),
]
Device = Annotated[str, parsing.device()]
RunDir = Annotated[Path | None, Option("--run-dir", help="The run's folder \\[default: runs/TIME_PRESET].")]
WithReport = Annotated[bool, Option("--report", help="Also write the run's report.html.")]
Wide = Annotated[
    bool, Option("--wide", help="Show every column of a table, though the terminal be narrower.")
]
Clean = Annotated[
    bool, Option("--clean", help="First delete the kernels' own machine code (docs/performance.md).")
]
AsJson = Annotated[bool, Option("--json", help="Print one JSON document and nothing else on stdout.")]
Seeds = Annotated[str, Option("--seeds", "--seed", help="Seeds, separated by commas.")]
Batch = Annotated[
    int | None, Option("--num-envs", help="Episodes played together \\[default: as many as sensible].")
]

# ------------------------------------------------------------------------------------------------------- eval

EvalRuns = Annotated[
    list[str] | None,
    _players(
        "RUN",
        "Trained policies: run folders or checkpoint folders.",
    ),
]
EvalControllers = Annotated[
    list[str] | None,
    _controllers(
        "straight, planner, bt or a tree's XML (repeatable); dwa, potential_field, velocity_obstacle, mppi = "
        "local planners of the literature; paper = bt on the paper's own stack, a row of "
        "its own; none = policies alone \\[default: straight, planner, bt, beside a RUN bt]. Privileged "
        "yardsticks: NAME+truth (a tree that knows where every moving body is), oracle (knows the future: an "
        "upper bound). A function of yours: mine.py:act (docs/extend.md).",
    ),
]
Planners = Annotated[
    list[str] | None,
    Option(
        "--planner",
        metavar="FILE.py:NAME",
        help="A route planner of yours, mine.py:plan, in the place of the built-in one: a row of its own, "
        "driven by bt (repeatable).",
        autocompletion=parsing.files(".py"),
    ),
]
Policies = Annotated[
    list[str] | None,
    Option(
        "--policy",
        metavar="FILE",
        help="A policy of yours: model.onnx, or mine.py:load, which returns one of any library; "
        "mine.py:load=TEXT hands it the text (repeatable).",
        autocompletion=parsing.files(".onnx", ".py"),
    ),
]
AllowCode = Annotated[
    bool,
    Option("--allow-code", help="With --resume: the Python files that the run folder names may be run."),
]
EvalEpisodes = Annotated[int, Option("--episodes", help="Episodes per seed.")]
Record = Annotated[
    int, Option("--record", help="Record the first K episodes of every method as MCAP with a picture.")
]
Video = Annotated[bool, Option("--video", help="Also a top-down video of every recorded episode.")]
DepthImages = Annotated[
    bool,
    Option(
        "--depth-images",
        help="Also record the depth camera: 2 Hz to look at, and every image exactly (uuv replay).",
    ),
]
Explain = Annotated[
    bool,
    Option(
        "--explain",
        help="Label the cause of every failure, judged from the truth: which sense or decision failed.",
    ),
]
ExplainRecord = Annotated[
    int | None,
    Option(
        "--explain-record",
        help="With --explain: log, picture, video of N of the worst failures per method \\[default: 3].",
    ),
]
EvalResume = Annotated[Path | None, _resume("Run folder of an interrupted evaluation to go on with.")]

# ------------------------------------------------------------------------------------------------------ train

TrainPreset = Annotated[
    str,
    Argument(
        metavar="PRESET",
        help=f"Training preset: {parsing.names('train')}, or a YAML file.",
        autocompletion=parsing.presets("train"),
    ),
]
TrainResume = Annotated[Path | None, _resume("Run folder to go on with, with its own config.")]
Iterations = Annotated[
    int | None,
    Option(
        "--iterations",
        help="Stop when so many are done in all; schedules run over train.iterations in any case.",
    ),
]
TrainEnvs = Annotated[int | None, Option("--num-envs", help="Envs stepped together (train.num_envs).")]
TrainSeed = Annotated[
    int | None, Option("--seed", help="Seed of networks, exploration and scenarios (train.seed).")
]
TrainWorld = Annotated[
    str | None,
    _preset("--world", "world", f"World: {_WORLDS}, or a YAML file \\[default: the training preset's]."),
]
TrainSensors = Annotated[
    str | None,
    _preset(
        "--sensors", "sensors", f"Sensors: {_SENSORS}, or a YAML file \\[default: the training preset's]."
    ),
]

# --------------------------------------------------------------------------------------------------- simulate

SimulateSeconds = Annotated[float, Option("--seconds", help="Duration \\[s].")]
SimulateVehicle = Annotated[str, _preset("--vehicle", "vehicle", f"Vehicle: {_VEHICLES}, or a YAML file.")]
Wrench = Annotated[str | None, Option("--wrench", help="Constant body wrench fx,fy,fz,mx,my,mz [N, N m].")]
Command = Annotated[
    str | None, Option("--command", help="Body velocity command u,v,w,r \\[m/s, rad/s] for the inner loop.")
]
Current = Annotated[str | None, Option("--current", help="Water velocity x,y,z \\[m/s].")]
DrivenBy = Annotated[
    str | None,
    Option(
        "--controller",
        metavar=_NAME,
        help="Who drives from rest to the goal of world open: bt or another tree, or mine.py:act.",
        autocompletion=parsing.controller_choices,
    ),
]
InitialRpy = Annotated[str | None, Option("--initial-rpy-deg", help="Roll, pitch, yaw \\[deg].")]
InitialVelocity = Annotated[str | None, Option("--initial-velocity", help="u,v,w,p,q,r \\[m/s, rad/s].")]
Neutral = Annotated[bool, Option("--neutral", help="Buoyancy equal to weight.")]
Substep = Annotated[float, Option("--dt", help="Dynamics substep \\[s].")]

# ------------------------------------------------------------------------------------------------------ watch

WatchControllers = Annotated[
    list[str] | None,
    _controllers(
        "Who drives, in turn (repeatable): as of uuv eval \\[default: bt, beside a RUN nobody else]."
    ),
]
WatchEpisodes = Annotated[int, Option("--episodes", help="Episodes per seed; 0 = on and on, until Ctrl-C.")]
Rate = Annotated[
    float, Option("--rate", help="Seconds of the episode in one of the clock's; 0 = as fast as it goes.")
]
Host = Annotated[
    str, Option("--host", help="Address to serve at; 0.0.0.0 shows it to every machine of the network.")
]
Port = Annotated[int, Option("--port", help="Port to serve at; 0 = a free one.")]
Origins = Annotated[
    list[str] | None,
    Option(
        "--origin",
        metavar="URL",
        help="Web page that may connect too, for example https://app.foxglove.dev (repeatable).",
    ),
]

# ------------------------------------------------------------------------------------------------ pilot, sitl

Mavlink = Annotated[
    str,
    Option(
        "--mavlink",
        metavar="udp:HOST:PORT",
        help="Where the vehicle's MAVLink is: udp:HOST:PORT listens there, udpout:HOST:PORT speaks first.",
    ),
]
PilotStart = Annotated[
    str, Option("--start", metavar="X,Y,Z", help="Where the vehicle is now \\[m], in the world's axes, z up.")
]
PilotGoal = Annotated[str, Option("--goal", metavar="X,Y,Z", help="Where it is to go \\[m].")]
Heading = Annotated[
    float | None,
    Option(
        "--heading",
        help="Compass heading of the world's x axis \\[deg] \\[default: where the vehicle looks at first].",
    ),
]
Arm = Annotated[
    bool,
    Option(
        "--arm",
        help="Arm and drive \\[default: a dry run].",
    ),
]
FenceBox = Annotated[
    str | None,
    Option("--box", metavar="X,Y,X,Y", help="Fence: least x, y, most x, y \\[m] \\[default: the tank]."),
]
FenceDepth = Annotated[
    str | None,
    Option("--depth", metavar="LEAST,MOST", help="Fence: depths \\[m] \\[default: the tank, 0.2 m within]."),
]
MostSpeed = Annotated[
    float, Option("--max-speed", help="Horizontal speed that is never asked beyond \\[m/s].")
]
LeastBattery = Annotated[float, Option("--battery", help="Voltage below which it surfaces \\[V].")]
VehicleId = Annotated[int, Option("--system", min=1, max=255, help="MAVLink id of the vehicle.")]
OperatorId = Annotated[
    int,
    Option("--operator", min=1, max=255, help="MAVLink id of the ground station whose heartbeat must come."),
]
HeardSenders = Annotated[
    list[str] | None,
    Option(
        "--sender",
        metavar="KIND=SYSTEM/COMPONENT",
        help="From whom a kind of message counts, in place of the usual senders: attitude, imu, pressure, "
        "position, battery, dvl or sonar (repeatable), for example dvl=255/0 or sonar=1/*.",
    ),
]
PilotSeconds = Annotated[
    float | None, Option("--seconds", help="Give the vehicle back after so long \\[default: never].")
]
PilotLog = Annotated[Path | None, Option("--log", help="MCAP to write \\[default: runs/pilot_TIME.mcap].")]
PilotForce = Annotated[bool, Option("--force", help="Replace the log that --log names.")]
PilotTree = Annotated[str, _tree("Who drives")]
PilotRate = Annotated[
    float,
    Option(
        "--rate",
        help="Seconds of the vehicle's clock in one of ours: 1 but for a simulated vehicle; 0 = follow its "
        "clock.",
    ),
]

SitlPort = Annotated[int, Option("--port", min=1, max=65535, help="UDP port of the first ArduSub's physics.")]
SitlHost = Annotated[str, Option("--host", help="Address to listen at.")]
Instances = Annotated[
    int, Option("--instances", help="ArduSubs (their -I 0, 1, ..); ports count on by ten, episodes by one.")
]
SensorPlaces = Annotated[
    list[str] | None,
    Option(
        "--mavlink",
        metavar="udp:HOST:PORT",
        help="Where the DVL, the sonar and the altimeter speak to (repeatable) \\[default: "
        "udp:127.0.0.1:14660 for ArduSub, udpout:127.0.0.1:14550 for uuv pilot].",
    ),
]
PlayOperator = Annotated[
    bool,
    Option(
        "--operator",
        help="Be the ground station too: its heartbeat, without which the pilot stops, and ArduSub's origin.",
    ),
]
SitlRate = Annotated[
    float, Option("--rate", help="Seconds of the water in one of the clock's, at most; 0 = as ArduSub asks.")
]
SitlSeconds = Annotated[float | None, Option("--seconds", help="End after so long \\[default: at Ctrl-C].")]
SitlOnce = Annotated[bool, Option("--once", help="End when the episode of every instance has ended.")]
SitlSeed = Annotated[int, Option("--seed", help="Seed of the episodes.")]
SitlEpisode = Annotated[int, Option("--episode", min=0, help="Episode of the first instance.")]

# ------------------------------------------------------------------------------------------------------ sweep

SweepRuns = Annotated[list[str] | None, _players("[RUN]...", "Trained policies, as for eval.")]
SweepControllers = Annotated[
    list[str] | None,
    _controllers("straight, planner, bt, a tree's XML or mine.py:act (repeatable) \\[default: bt]."),
]
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
SweepEpisodes = Annotated[int, Option("--episodes", help="Episodes per seed, cell and method.")]
EngineName = Annotated[
    str, parsing.choice("--engine", ("local", "ray"), "Who works: processes on this machine, or a cluster.")
]
Workers = Annotated[int, Option("--workers", help="Processes of the local engine.")]
Address = Annotated[
    str, Option("--address", help="Ray cluster: host:port, auto, or local (inside this process).")
]
SweepResume = Annotated[Path | None, _resume("Run folder of a sweep to go on with.")]

# ----------------------------------------------------------------------------------------- profile, reproduce

BatchSizes = Annotated[str, Option("--num-envs", help="Batch sizes, separated by commas.")]
WarmSensors = Annotated[str, Option("--sensors", help=f"Sensor presets, separated by commas: {_SENSORS}.")]
WarmWorkers = Annotated[int, Option("--workers", help="Sizes side by side \\[default: one per core].")]
TickedTree = Annotated[str, _tree("Tree that is ticked")]
ProfilePreset = Annotated[
    str,
    _preset(
        "--preset",
        "train",
        f"What learns in the rate with training: {parsing.names('train')}, or a YAML file.",
    ),
]
ProfileSeconds = Annotated[float, Option("--seconds", help="Measured time per batch size \\[s].")]
Density = Annotated[bool, Option("--density", help="Also loop time against D.")]
BudgetName = Annotated[
    str, parsing.choice("--budget", ("quick", "full"), "How much: half an hour on two cores, or overnight.")
]
OwnControllers = Annotated[
    list[str] | None,
    Option(
        "--controller",
        metavar="FILE.py:NAME",
        help="A controller of yours, mine.py:act, beside ours in every table (repeatable).",
        autocompletion=parsing.files(".py"),
    ),
]
ReproduceResume = Annotated[Path | None, _resume("Run folder of a reproduction to go on with.")]

# --------------------------------------------------------------------------------------------- report, export

ReportRuns = Annotated[
    list[Path],
    Argument(
        metavar="RUN...",
        help="Run folders; several make one page: trainings are compared, the rest follows.",
    ),
]
ReportOut = Annotated[
    Path | None, Option("--out", help="The page \\[default: RUN/report.html]; figures/ is made beside it.")
]
ReportPaper = Annotated[
    Path | None,
    Option(
        "--paper",
        help="New or empty folder for a paper's kit: figures as PDF and SVG, tables as LaTeX and CSV, "
        "captions.",
    ),
]
ReportForce = Annotated[bool, Option("--force", help="Replace files that are there already.")]
ExportRun = Annotated[str | None, _players("[RUN]", "Run folder or checkpoint folder.")]
ExportOut = Annotated[Path | None, Option("--out", help="New folder \\[default: runs/NAME_export].")]
ExportEvaluation = Annotated[
    list[Path] | None,
    Option("--evaluation", help="Run folder of 'uuv eval RUN': counts for the model card (repeatable)."),
]
ExportCheck = Annotated[
    Path | None, Option("--check", help="Verify an exported folder instead: sha256 and golden pairs.")
]
ExportForce = Annotated[bool, Option("--force", help="Replace the exported policy that --out names.")]
ExportStack = Annotated[
    Path | None,
    Option(
        "--stack",
        help="Write the whole stack of a log (RUN is an .mcap file) into this new folder, for a computer "
        "without Taichi and torch.",
    ),
]
ExportFor = Annotated[
    str, Option("--for", help="Computers that --stack writes code for: x86_64, aarch64, or both, by comma.")
]

# ----------------------------------------------------------------------------------------------------- replay

ReplayLog = Annotated[Path, Argument(help="A log of 'uuv eval --record N --depth-images'.")]
ReplayTree = Annotated[str | None, _tree("Tree in place of the one that the log holds")]
Drop = Annotated[float, Option("--drop", help="Share of the sensors' messages to lose, 0 to 1.")]
Jitter = Annotated[
    float, Option("--jitter", help="Messages arrive up to this much later \\[s], out of order too.")
]
Lose = Annotated[
    list[str] | None,
    Option(
        "--lose",
        metavar="SENSOR:FROM:TO",
        help="A sensor that is dead for a while \\[s]: imu, dvl, pressure, position, sonar or depth "
        "(repeatable).",
    ),
]
FaultSeed = Annotated[int, Option("--fault-seed", help="Of the random numbers of --drop and --jitter.")]

# ---------------------------------------------------------------------------------------------- presets, tree

PresetsAction = Annotated[
    str | None,
    Argument(
        metavar="show",
        help="'show' to print one preset as it is written.",
        autocompletion=lambda: ["show"],
    ),
]
PresetName = Annotated[
    str | None,
    Argument(
        metavar="NAME",
        help="Preset to show; KIND/NAME where two kinds have one of that name.",
        autocompletion=parsing.shown,
    ),
]
ExamplesFolder = Annotated[Path, Argument(metavar="FOLDER", help="Where to; what is there is kept.")]
Everything = Annotated[
    bool,
    Option(
        "--all",
        help="With show: every key that the preset gives, its own, those it builds on, and the defaults.",
    ),
]
EvaluatedRun = Annotated[
    Path | None,
    Argument(
        metavar="RUN",
        help="Run folder of an evaluation; without one, the tree alone.",
        autocompletion=parsing.evaluations,
    ),
]
ShownTree = Annotated[str, _tree("Tree")]
Dot = Annotated[bool, Option("--dot", help="Print Graphviz DOT instead.")]

# -------------------------------------------------------------------------------------------------------- log

LogFile = Annotated[Path, Argument(help="An .mcap file.")]
DriveLogs = Annotated[
    list[Path],
    Argument(
        help="Logs of drives: .mcap of ours, ArduSub's .bin or .tlog, or .csv with t,u,v,w,r,rpm_1,.. "
        "(docs/on_a_vehicle.md)."
    ),
]
IdentifyKnown = Annotated[
    str,
    parsing.choice(
        "--known",
        ("gain", "added-mass", "buoyancy"),
        "What is taken from --vehicle: speeds and rotor speeds alone tell ratios.",
    ),
]
IdentifySystem = Annotated[
    int | None,
    Option(
        "--system",
        min=1,
        max=255,
        help="Whose drives are read from a .tlog of several vehicles \\[default: whose motors it tells most "
        "of].",
    ),
]
IdentifyTruth = Annotated[
    bool, Option("--truth", help="Take the true motion of a simulated log, not what the instruments said.")
]
IdentifyOut = Annotated[
    Path | None,
    Option(
        "--out", help="Vehicle file, with a .png of the prediction beside it \\[default: NAME.vehicle.yaml]."
    ),
]
IdentifyForce = Annotated[bool, Option("--force", help="Replace files that are there.")]
LogFiles = Annotated[list[Path], Argument(help="Logs of the same episode; trajectories are overlaid.")]
LogForce = Annotated[bool, Option("--force", help="Replace the file that --out names.")]
LogExportOut = Annotated[Path, Option("--out", help="New or empty folder for the exported files.")]
Topics = Annotated[list[str] | None, Option("--topic", help="Only these topics (repeatable).")]
LogFormat = Annotated[str, Option("--format", help="json (a line a message), csv or npz (NumPy arrays).")]
RepairOut = Annotated[Path | None, Option("--out", help="Repaired file \\[default: NAME.repaired.mcap].")]
ConvertOut = Annotated[
    Path | None,
    Option(
        "--out",
        help="New file, or folder of a bag \\[default: NAME_rosbag2, NAME.log.mcap].",
    ),
]
ConvertTo = Annotated[
    str | None,
    Option(
        "--to",
        help="rosbag2 (a ROS 2 bag), or mcap (a log) \\[default: what --from is not].",
        autocompletion=lambda: ["mcap", "rosbag2"],
    ),
]
ConvertFrom = Annotated[
    str,
    Option(
        "--from",
        help="mcap (a log), or rosbag2 (a ROS 2 bag becomes a log).",
        autocompletion=lambda: ["mcap", "rosbag2"],
    ),
]
VideoOut = Annotated[
    Path | None,
    Option(
        "--out", help="Its ending says the format: .webm, .mp4 or .gif \\[default: the log's name, .webm]."
    ),
]
VideoSpeed = Annotated[float, Option("--speed", help="Times as fast as it was.")]
VideoFps = Annotated[float | None, Option("--fps", help="Frames per second \\[default: 15, GIF 10].")]
VideoWidth = Annotated[int | None, Option("--width", help="Width \\[px] \\[default: 1280, GIF 800].")]
PictureOut = Annotated[
    Path | None,
    Option(
        "--out",
        help="A .png file \\[default: the first log's name, .png].",
    ),
]
WithClearance = Annotated[bool, Option("--clearance", help="Colour the clearance field.")]
