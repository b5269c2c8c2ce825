"""The command line as a newcomer meets it: results, exit codes, one clear message for everything wrong."""

import ast
import contextlib
import errno
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from mcap.reader import make_reader
from taichi.lang.impl import default_cfg

import uuvtai
from tests import report_samples as samples
from tests.command import run_cli, uuv
from tests.small_sim import SmallSim
from uuvtai.common import exits
from uuvtai.common.errors import SettingError, SizeError
from uuvtai.compile.runtime import _thread_count
from uuvtai.config import loader
from uuvtai.console import doctor
from uuvtai.console.screen import Screen
from uuvtai.console.views import show_evaluation


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["evl"], "Did you mean 'eval'?"),
        (["eval", "--episodes", "x"], "valid integer"),
        (["eval", "--episodes", "0"], "--episodes 0: must be at least 1"),
        (["eval", "--episodes", "-3"], "must be at least 1"),
        (["eval", "--record", "-1"], "--record -1"),
        (["eval", "--seeds", "1,a"], "whole numbers separated by commas"),
        (["eval", "--seeds", "-99999999999"], "must be 0 or more"),
        (["eval", "--seeds", "-1"], "must be 0 or more"),
        (["eval", "--seeds", "1,1"], "given twice"),
        (["eval", "--episodes", "300000000"], "at most 1,000,000"),
        (["sweep", "--grid", "v=1e30"], "is no speed"),
        (["watch", "--host", "", "--port", "0"], "leave it out for 127.0.0.1"),
        (["train", "best", "--set", "train.num_envs=3"], "trials come in pairs"),
        (["eval", "--num-envs", "0"], "at least 1 env"),
        (["eval", "--num-envs", "-5"], "at least 1 env"),
        (["eval", "--num-envs", "900000"], "GiB"),
        (["eval", "--world", "pol"], "did you mean 'pool'"),
        (["eval", "--sensors", "nominl"], "did you mean 'nominal'"),
        (["eval", "--agent", "btt"], "did you mean 'bt'"),
        (["eval", "--agent", "nowhere.xml"], "no such file"),
        (
            ["eval", "--agent", "bt+trut"],
            "'+trut' is unknown; the one suffix is +truth, for example bt+truth",
        ),
        (["eval", "--agent", "btt+truth"], "did you mean 'bt'"),
        (["eval", "--agent", "orakel"], "--agent orakel: is no preset"),
        (["eval", "--agent", "oracle", "--record", "1"], "the oracle drives no vehicle"),
        (["eval", "--set", "world.n_dynmic=1"], "did you mean 'n_dynamic'"),
        (["eval", "--set", "mapping.static_hit=.nan"], "finite"),
        (["eval", "-S", "-1"], "greater than or equal to 0"),
        (["eval", "--speed", "nan"], "finite"),
        (["eval", "--device", "tpu"], "use auto, cpu or cuda"),
        (["eval", "--agent", "no/such/run"], "is no preset, file or run folder"),
        (["eval", "--agent", "."], "is no trained policy"),
        (["eval", "runs/mine"], "Got unexpected extra argument(s) (runs/mine); now it is --agent NAME|FILE"),
        (["sweep", "--controller", "best"], "No such option: --controller; now it is --agent NAME"),
        (["eval", "--policy=model.onnx"], "No such option: --policy; now it is --agent FILE"),
        (["eval", "-v", "1"], "No such option: -v; now it is --speed"),
        (["train", "--stack", "paper"], "No such option: --stack; now it is --agent NAME, or --set stack="),
        (["train", "--num-envs", "4"], "No such option: --num-envs; now it is --set train.num_envs=N"),
        (["train", "--lr", "1e-4"], "No such option: --lr; config keys: --set KEY=VALUE\n"),
        (["warm"], "No such command 'warm'; now it is uuv doctor --compile"),
        (["tree", "--dot"], "No such command 'tree'; now it is uuv presets show bt"),
        (["log", "video", "a.mcap"], "now it is uuv log render FILE --out NAME.mp4"),
        (["presets", "show", "pool", "--dot"], "--run, --dot: are of a tree"),
        (["log", "render", "a.mcap", "--fps", "5"], "--speed, --fps: are of a video"),
        (["log", "render", "a.mcap", "--out", "a.gif", "--clearance"], "are of a picture"),
        (["eval", "--agent", "none"], "--agent none: is no preset"),
        (["train", "constnt_20"], "did you mean 'constant_20'"),
        (["train", "nowhere.yaml"], "no such file"),
        (["train", "smoke", "--set", "ppo.gama=1"], "did you mean 'gamma'"),
        (["train", "smoke", "--iterations", "0"], "--iterations 0: at least 1"),
        (["train", "smoke", "--set", "train.num_envs=0"], "train.num_envs"),
        (["train", "smoke", "--set", "train.num_envs=900000"], "GiB"),
        (["train", "smoke", "--seed", "-1"], "train.seed"),
        (["train", "smoke", "--seed", "500000"], "must differ from train.seed"),
        (["train", "smoke", "--speed", "nan"], "finite"),
        (["train", "smoke", "--world", "pol"], "did you mean 'pool'"),
        (["train", "smoke", "--device", "tpu"], "use auto, cpu or cuda"),
        (["train", "--resume", "no/such/run"], "is no run folder"),
        (["train", "smoke", "--resume", "run"], "PRESET smoke: a resumed run keeps its own"),
        (["train", "--resume", "run", "--seed", "3"], "--seed 3: a resumed run keeps its own"),
        (["simulate", "--seconds", "nan"], "seconds"),
        (["simulate", "--seconds", "-1"], "seconds"),
        (["simulate", "--seconds", "1", "--wrench", "1,2"], "give 6 finite numbers"),
        (["simulate", "--seconds", "1", "--wrench", "1,2,3,4,5,inf"], "give 6 finite numbers"),
        (["simulate", "--seconds", "1", "--dt", "0"], "dt"),
        (["simulate", "--seconds", "1", "--vehicle", "bluerov9"], "did you mean"),
        (["profile", "--num-envs", "1,x"], "whole numbers"),
        (["profile", "--num-envs", "0"], "at least 1 env"),
        (["profile", "--seconds", "0"], "positive"),
        (["presets", "show"], "uuv presets show NAME"),
        (["presets", "show", "nothing"], "is no preset"),
        (["presets", "show", "bt", "--run", "no/such/run"], "is no run folder"),
        (["report", "no/such/run"], "is no run folder"),
        (["report", "."], "has nothing to report yet"),
        (["report", ".", "."], "--out FILE"),
        (["report", ".", "--out", "."], "is a folder"),
    ],
)
def test_bad_usage_is_one_message_and_exit_2(capfd, tmp_path, monkeypatch, arguments, says):
    monkeypatch.chdir(tmp_path)
    code, out, err = uuv(capfd, *arguments)
    assert code == 2, err
    assert says in err
    assert "Traceback" not in err
    assert out == ""
    assert not list(tmp_path.iterdir()), "nothing may be left behind"


@pytest.mark.parametrize("command", ["info", "repair", "render"])
@pytest.mark.parametrize("content", [None, b"", b"not a log", b"\x89MCAP0\r\n" + b"\x00" * 40])
def test_missing_and_corrupt_logs_are_refused(capfd, tmp_path, command, content):
    log = tmp_path / "broken.mcap"
    if content is not None:
        log.write_bytes(content)
    code, _out, err = uuv(capfd, "log", command, str(log))
    assert code == 2, err
    assert "broken.mcap" in err
    assert "Traceback" not in err
    assert {p.name for p in tmp_path.iterdir()} <= {"broken.mcap"}


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["simulate", "--seconds", "1", "--vehicle", "[/x].yaml"], "[/x].yaml"),
        (["log", "info", "[/x].mcap"], "[/x].mcap: cannot open"),
        (["report", "[/x]"], "[/x]: is no run folder"),
        (["eval", "--world", "a/" + 5000 * "b" + ".yaml"], "too long"),
        (["eval", "--resume", "nowhere"], "nowhere: is no run folder"),
        (["eval", "--resume", "nowhere", "--episodes", "64"], "--episodes 64: a resumed run keeps its own"),
        (["eval", "--agent", "bt", "--resume", "nowhere"], "--agent ['bt']: a resumed run keeps its own"),
        (["train", "smoke", "--set", "train.scenes=[[9, 9999, 1.0]]"], "do not fit"),
        (["train", "smoke", "--set", "policy.initial_std=0.01"], "lies below the floor"),
    ],
)
def test_what_once_was_a_traceback_or_passed_for_a_failure_is_refused(
    capfd, tmp_path, monkeypatch, arguments, says
):
    monkeypatch.chdir(tmp_path)
    assert_refused(uuv(capfd, *arguments), says, tmp_path)


_IN_TURN = """
import contextlib, io, json, os, sys
from uuvtai.cli import main
ended = []
for words, threads in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    os.environ["UUV_NUM_THREADS"] = threads
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(words)
        except SystemExit as left:
            ended.append((left.code, out.getvalue(), err.getvalue()))
from uuvtai.compile.runtime import start_taichi
start_taichi("cpu", "f64")  # what runs already, or it is refused
print(json.dumps(ended))
"""


@pytest.fixture(scope="module")
def simulations(tmp_path_factory):
    """How simulations ended, in turn in one process of their own: its folder, and (code, stdout, stderr) of
    one with a nonsense thread count, of one that diverges, and of one whose vehicle looks like markup."""
    folder = tmp_path_factory.mktemp("simulations")
    (folder / "a[/x]").mkdir(parents=True)
    shutil.copy(loader.preset_path("vehicle", "bluerov2"), folder / "a[/x]/odd.yaml")
    brief = ["simulate", "--seconds", "0.1"]
    diverging = ["simulate", "--seconds", "4", "--dt", "0.5", "--wrench", "90,0,0,0,0,5"]
    told = [(brief, "0"), (diverging, "1"), ([*brief, "--vehicle", "a[/x]/odd.yaml"], "1")]
    command = [sys.executable, "-c", _IN_TURN, json.dumps(told)]
    environment = os.environ | {"PYTHONPATH": str(Path(uuvtai.__file__).parents[1])}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    return folder, [tuple(ended) for ended in json.loads(done.stdout.splitlines()[-1])]


def test_a_simulation_that_diverges_is_refused_with_what_to_type(simulations):
    folder, (_, diverging, _) = simulations
    assert_refused(diverging, "use a smaller substep, --dt 0.125", folder, left=["a["])


def assert_refused(ended, says, folder, left=()):
    code, out, err = ended
    assert (code, out) == (2, "")
    assert says in " ".join(err.split())
    assert "Traceback" not in err and "a bug of ours" not in err
    assert [path.name for path in folder.iterdir()] == list(left)


def in_a_process(folder, *arguments, stdout=subprocess.PIPE):
    done = subprocess.run(
        [sys.executable, "-m", "uuvtai", *arguments], stdout=stdout, stderr=subprocess.PIPE, text=True,
        cwd=folder, check=False,
        env=os.environ | {"PYTHONPATH": str(Path(uuvtai.__file__).parents[1])},
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("text", ["abc", "0", "-1", "1.5", "99999999999999999999"])
def test_a_nonsense_thread_count_is_named(text):
    with pytest.raises(SettingError, match=re.escape(f"UUV_NUM_THREADS='{text}'")):
        _thread_count(text)


def test_a_command_refuses_a_nonsense_thread_count(simulations):
    code, _, err = simulations[1][0]
    assert code == 2 and "UUV_NUM_THREADS='0'" in err


def test_text_from_outside_is_never_markup(tmp_path, monkeypatch, capfd, evaluation, simulations):
    """Names of run folder, vehicle and agent that look like markup, in every table."""
    folder, document = evaluation
    odd = json.loads(json.dumps(document))
    odd["world"] = odd["sensors"] = "[/x]"
    for agent in odd["agents"]:
        agent["name"] = "[/x]" + agent["name"]
    show_evaluation(Screen(), odd, Path("[/x]"))
    monkeypatch.chdir(tmp_path)
    Path("a[/x]").mkdir(parents=True)
    shutil.copy(folder / "logs/bt_seed3_episode0.mcap", "a[/x]/log.mcap")
    assert uuv(capfd, "log", "info", "a[/x]/log.mcap")[0] == 0
    code, out, err = simulations[1][2]
    assert code == 0 and "a[/x]/odd.yaml: 0.1 s" in out, err


@pytest.mark.parametrize("error", [
    KeyError("x"), ValueError("y"), RuntimeError("z"), OverflowError("w"), StopIteration(), LookupError("v"),
])  # fmt: skip
def test_a_bug_is_one_line_exit_1_and_a_file_with_the_traceback(error, capfd, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.delenv("UUV_DEBUG", raising=False)
    assert exits.guarded(lambda: _fail(error)) == 1
    _, err = capfd.readouterr()
    [kept] = tmp_path.iterdir()
    assert len(err.splitlines()) == 1 and str(kept) in err and type(error).__name__ in err
    assert "Traceback" in kept.read_text() and "_fail" in kept.read_text()
    monkeypatch.setenv("UUV_DEBUG", "1")
    assert exits.guarded(lambda: _fail(error)) == 1
    assert "Traceback" in capfd.readouterr().err and list(tmp_path.iterdir()) == [kept]


def _fail(error):
    raise error


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "a/b"), 1),
        (PermissionError(errno.EACCES, "Permission denied", "a/b"), 1),
        (MemoryError(), 1),
        (RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory"), 1),
        (OSError(errno.ENAMETOOLONG, "File name too long", "a"), 2),
        (SizeError("too much"), 2),
        (SettingError("no"), 2),
    ],
)
def test_what_the_machine_refuses_is_no_bug(error, code, capfd, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert exits.guarded(lambda: _fail(error)) == code
    assert len(capfd.readouterr().err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such device here")
def test_results_that_cannot_be_written_are_told_once(tmp_path):
    with open("/dev/full", "w") as full:
        code, _, err = in_a_process(tmp_path, "presets", stdout=full)
    assert code == 1 and len(err.splitlines()) == 1 and "No space left" in err


@pytest.mark.skipif(os.name != "posix", reason="a shell closes them")
def test_closed_streams_are_like_the_null_device(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(Path(uuvtai.__file__).parents[1])}
    for closed in (">&-", "<&- >&- 2>&-"):
        command = f"exec {sys.executable} -m uuvtai presets show sensors/clean {closed}"
        done = subprocess.run(
            ["sh", "-c", command], capture_output=True, cwd=tmp_path, env=environment, check=False
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


def test_every_refusal_of_the_package_is_of_one_type():
    """Modules whose errors reach the user raise nothing plain: a plain one would be told as a bug of ours."""
    root = Path(uuvtai.__file__).parent
    plain = {
        "ValueError", "RuntimeError", "MemoryError", "OverflowError", "FloatingPointError", "OSError",
        "KeyError",
    }  # fmt: skip
    found = {}
    for path in [
        *root.glob("evaluation/*.py"), *root.glob("report/*.py"), root / "sim/behavior_tree.py",
        root / "sim/setup.py", root / "compile/runtime.py", root / "common/statistics.py",
        root / "learning/runner.py",
    ]:  # fmt: skip
        raised = [
            node.exc.func.id
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Raise)
            and isinstance(node.exc, ast.Call)
            and isinstance(node.exc.func, ast.Name)
        ]
        if odd := [name for name in raised if name in plain]:
            found[str(path.relative_to(root))] = sorted(set(odd))
    assert found == PLAIN


PLAIN = {
    "evaluation/failure_causes.py": ["RuntimeError"],  # a replay that ends otherwise: a bug of ours
    "common/statistics.py": ["ValueError"],  # counts that cannot be: a bug of ours
    "sim/behavior_tree.py": ["ValueError"],  # told by its caller, with the file that it comes from
    "report/recorded.py": ["ValueError"],  # told by ``drawing``, with the log that it comes from
    "compile/runtime.py": ["RuntimeError"],  # two runtimes in one process: a mistake of a Python caller
}


def test_presets_are_listed_and_shown(capfd):
    code, out, _ = uuv(capfd, "presets", "--json")
    listed = json.loads(out)
    assert code == 0
    assert {"pool", "gauntlet", "column", "maze", "netpen", "transfer", "open"} <= set(listed["world"])
    assert {"clean", "paper", "nominal", "harsh", "multibeam", "multibeam_image", "ping360", "3d15"} == set(
        listed["sensors"]
    )
    assert {"paper", "ppo", "constant_20", "no_risk_scaling", "no_world_model", "smoke"} <= set(
        listed["train"]
    )
    code, out, _ = uuv(capfd, "presets", "show", "gauntlet", "--all")
    assert code == 0
    assert "n_dynamic: 6" in out
    code, out, err = uuv(capfd, "presets", "show", "paper")
    assert code == 0
    assert "range_sigma_m: 0.02" in out
    assert "uuv presets show train/paper" in err
    code, out, _ = uuv(capfd, "presets", "show", "train/paper")
    assert code == 0
    assert "rollout_steps: 64" in out


def test_doctor_finds_the_lock_of_a_killed_process(tmp_path, monkeypatch):
    """With it Taichi neither reads nor writes its cache: each start takes a minute, with one warning."""
    monkeypatch.setattr(default_cfg(), "offline_cache_file_path", str(tmp_path))
    lock = tmp_path / "ticache.lock"
    lock.touch()
    assert "0.0 MB" in doctor._cache(), "a fresh lock has an owner"
    os.utime(lock, (time.time() - 3600,) * 2)
    with pytest.raises(
        RuntimeError, match=r"ticache\.lock was left by a process that was killed.*delete this file"
    ):
        doctor._cache()


def test_a_start_removes_the_lock_of_a_killed_process_and_no_other(tmp_path):
    old, fresh = tmp_path / "ticache.lock", tmp_path / "other.lock"
    for lock in (old, fresh):
        lock.touch()
    os.utime(old, (time.time() - 3600,) * 2)
    start = "from uuvtai.compile.runtime import start_taichi; start_taichi('cpu')"
    environment = os.environ | {"TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", start], env=environment, capture_output=True, text=True, check=True
    )
    assert "Lock" not in done.stdout + done.stderr
    assert not old.exists() and fresh.exists()


@pytest.fixture(scope="module")
def evaluation(taichi_runtime, tmp_path_factory):
    """One real evaluation: two controllers, recorded, as JSON."""
    folder, out = tmp_path_factory.mktemp("eval") / "run", io.StringIO()
    with contextlib.redirect_stdout(out):
        code = run_cli(
            "eval", "--agent", "straight,bt", "--episodes", "4", "--seeds", "3", *SmallSim.OPTIONS,
            "--record", "1", "--set", "episode.horizon_steps=400", "--run-dir", folder, "--report", "--json",
        )  # fmt: skip
    assert code == 0
    return folder, json.loads(out.getvalue())


def test_eval_prints_one_document_with_every_documented_key(evaluation):
    _, document = evaluation
    assert {"schema", "world", "S", "D", "v_m_s", "sensors", "seeds", "episodes_per_seed", "agents"} <= set(
        document
    )
    assert [m["name"] for m in document["agents"]] == ["straight", "bt"]
    for agent in document["agents"]:
        assert {
            "name", "episodes", "outcomes", "success_rate", "success_ci95", "collision_rate",
            "collision_ci95", "return_mean",
            "time_mean_s", "tts_s", "time_to_success_mean_s", "min_clearance_mean_m", "path_length_mean_m",
            "replans_per_episode", "replans_by_trigger",
            "planned_by", "env_steps", "wall_s", "env_steps_per_s", "episodes_detail",
        } <= set(agent)  # fmt: skip
        assert sum(agent["outcomes"].values()) == agent["episodes"] == 4
        assert set(agent["outcomes"]) == {"success", "collision", "ttc", "out_of_tank", "timeout"}
        assert [d["episode"] for d in agent["episodes_detail"]] == [0, 1, 2, 3]
        assert agent["env_steps"] == sum(round(d["time_s"] / 0.02) for d in agent["episodes_detail"])


def messages_of(log):
    """(topic, time, content) of every message of a recorded episode."""
    with log.open("rb") as file:
        return [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in make_reader(file).iter_messages()
        ]


_THEN_INTERRUPTED = """
import json, os, sys
import uuvtai.evaluation.evaluate
from uuvtai.__main__ import main
first, second = json.loads(sys.argv[1])
if child := os.fork():
    assert os.waitpid(child, 0)[1] == 0
sys.argv = ["uuv", *(second if child else first)]
main()
"""


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A process evaluates on one thread, then another begins a long evaluation and is interrupted as soon as
    a log has messages: (its folder, exit code, stdout, stderr)."""
    folder = tmp_path_factory.mktemp("alone")
    usual = [*SmallSim.OPTIONS, "--set", "episode.horizon_steps=400", "--seeds", "3", "--agent", "bt"]
    told = [
        ["eval", *usual, "--episodes", count, "--record", recorded, "--json", "--run-dir", str(folder / name)]
        for name, count, recorded in (("run", "4", "1"), ("cut", "400", "400"))
    ]
    process = subprocess.Popen(
        [sys.executable, "-c", _THEN_INTERRUPTED, json.dumps(told)], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, env={**os.environ, "UUV_NUM_THREADS": "1"},
    )  # fmt: skip
    deadline = time.monotonic() + 600
    while not _parts_with_messages(folder / "cut") and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=240)
    return folder, process.returncode, out, err


def test_one_thread_gives_the_same_episodes_to_the_last_digit(evaluation, alone):
    """Outcomes of four episodes, and all that one of them wrote down on its way."""
    (folder, document), (place, _, out, _) = evaluation, alone
    assert json.loads(out)["agents"][0]["episodes_detail"] == document["agents"][1]["episodes_detail"]
    one, together = (messages_of(run / "logs/bt_seed3_episode0.mcap") for run in (place / "run", folder))
    assert {topic for topic, _, _ in one} >= {"/sonar/scan", "/map/static", "/map/dynamic"}
    assert one == together


def test_eval_leaves_a_complete_run_folder(evaluation):
    folder, document = evaluation
    names = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert {
        "config.yaml", "run.json", "eval/result.json", "eval/tree.json", "eval/trees/bt.xml",
        "logs/bt_seed3_episode0.mcap",
        "logs/straight_seed3_episode0.mcap", "pictures/seed3_episode0.png",
        "report.html", "figures/agents.png",
    } <= names  # fmt: skip
    assert not [n for n in names if n.endswith((".tmp", ".part"))]
    run = json.loads((folder / "run.json").read_text())
    assert (run["status"], run["exit"]) == ("finished", 0)
    assert json.loads((folder / "eval/result.json").read_text()) == document


def test_tree_shows_the_use_of_every_node(evaluation, capfd):
    folder, document = evaluation
    code, out, _ = uuv(capfd, "presets", "show", "bt", "--run", str(folder), "--json")
    assert code == 0
    nodes = json.loads(out)["nodes"]
    assert nodes[0]["share"] == 1.0
    bt = document["agents"][1]
    # the tree is ticked once when the episode begins and after every step
    assert nodes[0]["ticks"] == bt["env_steps"] + bt["episodes"]
    assert sum(n["acted"] for n in nodes) <= nodes[0]["ticks"]
    code, _, err = uuv(capfd, "presets", "show", "planner", "--run", str(folder))
    assert code == 2
    assert "has no tree 'planner'" in err
    code, out, _ = uuv(capfd, "presets", "show", "bt", "--run", str(folder))
    assert code == 0 and "acted: control steps whose action the leaf set" in out
    code, _, err = uuv(capfd, "presets", "show", "bt", "--run", "bt")
    assert code == 2 and "bt: is no run folder" in err


def test_without_a_preset_the_policy_trains(capfd, monkeypatch):
    asked, run = [], "runs/my first"
    done = {"run": run, "learner": "ppo", "score": 0.5, "checkpoint": f"{run}/checkpoints/step_000006"}
    monkeypatch.setattr(
        "uuvtai.learning.runner.train", lambda request, *_: (asked.append(request) or done, Path())
    )
    code, out, _ = uuv(capfd, "train")
    assert code == 0 and out.splitlines() == [
        f"best checkpoint: {run}/checkpoints/step_000006 (50.0 % in its evaluation)",
        f"next: uuv eval --agent '{run}' --agent bt",
    ]
    assert [(request.preset, request.config) for request in asked] == [
        ("policy", loader.load_training("policy"))
    ]


@pytest.fixture
def compared(monkeypatch, tmp_path):
    """An evaluation and its report as they would be; what was asked for, and which page was opened."""
    rows = [samples.agent(name, n, 8 - n, privileged=False) for name, n in (("planner", 3), ("bt", 6))]
    document = samples.evaluation_document(*rows) | {"paired": [], "remainder": []}
    asked, opened, folder = [], [], tmp_path / "my run"
    monkeypatch.setattr(
        "uuvtai.evaluation.evaluate.compare", lambda request, _: (asked.append(request) or document, folder)
    )
    monkeypatch.setattr(
        "uuvtai.report.build.report", lambda *_: SimpleNamespace(page=folder / "report.html", figures=[])
    )
    monkeypatch.setattr("webbrowser.open_new_tab", lambda page: bool(opened.append(page)))
    return asked, opened, folder


def test_the_demo_tells_who_won_where_the_report_is_and_what_comes_next(capfd, compared):
    asked, opened, folder = compared
    code, out, err = uuv(capfd, "demo", "--open", "--episodes", "8")
    assert (
        code == 0
        and out.splitlines()[-1]
        == "bt reached the goal in 6 of 8 episodes (12.0 s on average), planner in 3 (10.5 s)."
    )
    assert err.splitlines()[-4:] == [
        f"run folder: {folder}",
        f"report: {folder / 'report.html'}",
        f"--open: no browser was found here; open {folder / 'report.html'} in one",
        "next: uuv eval --agent bt --world gauntlet -D 9 --speed 1.5 --explain --report",
    ]
    assert opened == [(folder / "report.html").as_uri()]
    assert [(r.agents, r.world, r.episodes, r.record, r.seeds) for r in asked] == [
        (["straight", "planner", "bt"], "pool", 8, 2, [0])
    ]
    assert uuv(capfd, "demo", "--episodes", "0")[0] == 2


def test_an_evaluation_leads_on_to_its_report(capfd, compared):
    _asked, opened, folder = compared
    _, out, err = uuv(capfd, "eval")
    assert (
        out.splitlines()[-1]
        == "bt reached the goal in 6 of 8 episodes (12.0 s on average), planner in 3 (10.5 s)."
    )
    assert err.splitlines()[-2:] == [f"run folder: {folder}", f"next: uuv report '{folder}'"]
    _, _, err = uuv(capfd, "eval", "--report")
    assert err.splitlines()[-1] == f"report: {folder / 'report.html'}" and not opened
    assert uuv(capfd, "report", str(folder), "--open")[0] == 0 and len(opened) == 1
    assert uuv(capfd, "report", str(folder), "--paper", "x", "--open")[0] == 2


def test_an_existing_run_folder_is_never_overwritten(evaluation, capfd):
    folder, _ = evaluation
    before = (folder / "run.json").read_text()
    for command in (["eval", "--episodes", "1"], ["train", "smoke"]):
        code, _, err = uuv(capfd, *command, "--run-dir", str(folder))
        assert code == 2
        assert "already there and not empty" in err
    assert (folder / "run.json").read_text() == before


def test_a_place_without_room_for_a_run_folder_is_refused_before_anything_is_compiled(
    tmp_path, capfd, monkeypatch
):
    (tmp_path / "file").write_text("mine")
    monkeypatch.setattr("uuvtai.sim.sim.Sim", lambda *_: pytest.fail("compiles"))
    for command in (["eval", "--episodes", "1"], ["train", "smoke"]):
        code, _, err = uuv(capfd, *command, "--run-dir", str(tmp_path / "file/run"))
        assert code == 2
        assert "Not a directory" in err and "give a folder that can be written: --run-dir DIR" in err
    assert (tmp_path / "file").read_text() == "mine"


def test_a_run_folder_that_cannot_be_written_is_refused(tmp_path, monkeypatch, capfd):
    """Nobody, not even root, makes a folder there; that shows only when it is tried."""
    monkeypatch.chdir(tmp_path)
    code, _, err = uuv(capfd, "eval", "--episodes", "1", *SmallSim.OPTIONS, "--run-dir", "/proc/nowhere/run")
    assert code == 2
    assert "give a folder that can be written: --run-dir DIR" in err
    assert "Traceback" not in err


CHUNK = 0x06
"""opcode of the MCAP record that holds messages"""


def _opcodes(part: Path) -> set[int]:
    """Opcodes of whole records of an unfinished log: each a byte, eight bytes of length, content."""
    data, at, found = part.read_bytes(), 8, set()
    while at + 9 <= len(data):
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        if end <= len(data):
            found.add(data[at])
        at = end
    return found


def _parts_with_messages(folder: Path) -> list[Path]:
    """Unfinished logs that have been flushed once at least, however large header and attachments are."""
    return [part for part in (folder / "logs").glob("*.part") if part.exists() and CHUNK in _opcodes(part)]


def test_interrupt_leaves_a_marked_run_and_repairable_logs(alone, capfd):
    folder, code, _, err = alone
    assert code == 130, err
    assert "interrupted" in err
    assert "Traceback" not in err
    assert json.loads((folder / "cut/run.json").read_text())["status"] == "interrupted"
    code, out, err = uuv(capfd, "log", "repair", _parts_with_messages(folder / "cut")[0])
    assert code == 0, err
    assert "messages recovered" in out
