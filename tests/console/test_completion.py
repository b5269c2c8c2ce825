"""The command line answers quickly: what help, completion and light commands import, what is offered."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from docs.writers import commands
from tests.command import uuv
from tests.repository.test_docs import fault
from uuvtai.common.presets import KINDS, preset_names
from uuvtai.console import parsing

ROOT = Path(commands.__file__).parents[2]
HEAVY = {"taichi", "torch", "cv2", "ompl", "numpy", "yaml", "matplotlib", "tensorboard", "mcap"}
"""Pydantic is not among them: Typer loads it where it is there."""


def every_command():
    """(words after ``uuv``, command) of the command line, its groups among them."""
    root = commands.app()
    yield (), root
    for name, command in root.commands.items():
        yield (name,), command
        for inner, below in getattr(command, "commands", {}).items():
            yield (name, inner), below


COMMANDS = dict(every_command())


_IN_TURN = """
import json, os, sys
from uuvtai.cli import main
for number, (words, environment) in enumerate(json.loads(sys.argv[1])):
    if child := os.fork():
        os.waitpid(child, 0)
        continue
    for stream, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(f"{sys.argv[2]}/{number}.{name}", os.O_WRONLY | os.O_CREAT), stream)
    os.environ.update(environment)
    try:
        main(*words)
    except SystemExit as left:
        print("\\nleft", left.code or 0, *sys.modules, file=sys.stderr)
    sys.stdout.flush(), sys.stderr.flush()
    os._exit(0)
"""


def ended(tmp_path, cases, cwd=None):
    """(stdout, exit code, modules loaded) of commands, each in a process of its own that has imported the
    command line and nothing else. ``cases``: (words or, for those of the environment, none; environment)."""
    told = tmp_path / "told"
    told.mkdir()
    command = [sys.executable, "-c", _IN_TURN, json.dumps(cases), str(told)]
    subprocess.run(command, check=True, cwd=cwd, env=os.environ | {"PYTHONPATH": str(ROOT)})
    for number, _ in enumerate(cases):
        err = (told / f"{number}.err").read_text()
        assert "Traceback" not in err, err
        _left, code, *modules = err.splitlines()[-1].split()
        yield (told / f"{number}.out").read_text(), int(code), set(modules)


def test_light_commands_import_little(tmp_path):
    """Help and presets; a tree is printed without torch and Taichi."""
    trees = [["presets", "show", *line] for line in (["bt"], ["planner", "--dot"], ["bt", "--json"])]
    helps = [["--version"], ["--help"], ["eval", "-h"], ["log", "-h"]]
    presets = [["presets"], ["presets", "show", "sensors/paper", "--json"]]
    heavy = [{"torch", "taichi", "cv2"}] * 3 + [HEAVY] * 4 + [HEAVY - {"yaml"}] * 2
    words = [*trees, *helps, *presets]
    found = ended(tmp_path, [([line], {}) for line in words])
    for line, unwanted, (out, code, modules) in zip(words, heavy, found, strict=True):
        assert out and code == 0 and not unwanted & modules, line
        assert ("FollowRoute" in out) == (line in trees) and out.startswith("digraph") == ("--dot" in line)


# ------------------------------------------------------------------------------------------------------- help


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: " ".join(words) or "uuv")
def test_every_help_has_an_example_that_can_be_parsed(words):
    found = re.fullmatch(r"Example: uuv (.+)", COMMANDS[words].epilog or "")
    assert found, f"uuv {' '.join(words)} has no example"
    line = shlex.split(found[1])
    assert tuple(line[: len(words)]) == words
    assert not fault(line), fault(line)


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: " ".join(words) or "uuv")
def test_h_is_help(words, capfd):
    code, out, _err = uuv(capfd, *words, "-h")
    assert code == 0 and "Usage: uuv" in out and "Example: uuv" in out


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: " ".join(words) or "uuv")
def test_what_may_be_typed_stands_beside_every_option(words):
    """Presets and words are listed; no free <str> where there are only so many."""
    listed = {"--world": "world", "--sensors": "sensors", "--vehicle": "vehicle", "--preset": "train"}
    for parameter in COMMANDS[words].params:
        answer = f"{parameter.metavar or ''} {getattr(parameter, 'help', '') or ''}"
        for option in parameter.opts:
            if option in listed:
                assert all(name in answer for name in preset_names(listed[option])), f"{words} {option}"
            if option in ("--device", "--engine", "--budget"):
                assert "|" in parameter.metavar


# ---------------------------------------------------------------------------------------------------- choices


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["eval", "--device", "gpu"], "--device gpu: use auto, cpu or cuda; did you mean 'cuda'?"),
        (["train", "smoke", "--device", "CUDA"], "use auto, cpu or cuda"),
        (["profile", "--device", "cup"], "did you mean 'cpu'"),
        (["sweep", "--engine", "rai"], "--engine rai: use local or ray; did you mean 'ray'?"),
        (["reproduce", "--budget", "quik"], "did you mean 'quick'"),
        (["presets", "show", "gauntlt"], "did you mean 'gauntlet' (world)?"),
        (["presets", "show", "constnt_20"], "did you mean 'constant_20' (train)?"),
        (["presets", "show", "train/constnt_20"], "did you mean 'constant_20'"),
    ],
)
def test_a_wrong_word_is_refused_at_once_and_the_right_one_named(
    arguments, says, capfd, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    code, out, err = uuv(capfd, *arguments)
    assert code == 2 and says in err
    assert out == "" and "starting" not in err and not list(tmp_path.iterdir())


# ------------------------------------------------------------------------------------------------- completion


def completion(words, shell="bash"):
    """What a shell sets to ask what may follow these words, the last half-typed."""
    typed = "uuv " + " ".join(words)
    return {
        "_UUV_COMPLETE": f"complete_{shell}", "COMP_WORDS": typed, "COMP_CWORD": str(len(words)),
        "_TYPER_COMPLETE_ARGS": typed,
    }  # fmt: skip


@pytest.fixture
def runs(tmp_path):
    """A folder with a training, an evaluation and a stray file."""
    for name, inner in (("first", "checkpoints/step_1"), ("first_eval", "eval")):
        (tmp_path / "runs" / name / inner).mkdir(parents=True)
        (tmp_path / "runs" / name / "run.json").write_text("{}")
    (tmp_path / "runs/first_eval/eval/tree.json").write_text("{}")
    (tmp_path / "runs/notes.txt").write_text("x")
    (tmp_path / "mine.yaml").write_text("world: {}")
    (tmp_path / "mine.xml").write_text("<root/>")
    return tmp_path


OFFERED = [
    (["ev"], ["eval"]),
    (["eval", "--world", "ga"], ["gauntlet", "gauntlet_inertial"]),
    (["eval", "--world", "mi"], ["mine.yaml"]),
    (["eval", "--sensors", "n"], ["nominal"]),
    (["train", "cons"], ["constant_20"]),
    (["profile", "--agent", "pl"], ["planner"]),
    (["profile", "--agent", "mi"], ["mine.xml"]),
    (["sweep", "--grid", "cau"], ["caution"]),
    (["eval", "--agent", "bt,str"], ["bt,straight", "bt,straight+truth"]),
    (["eval", "--agent", "runs/f"], ["runs/first", "runs/first_eval/"]),
    (["train", "--resume", "runs/"], ["runs/first", "runs/first_eval"]),
    (["presets", "show", "bt", "--run", "runs/"], ["runs/first/", "runs/first_eval"]),
    (["eval", "--device", ""], ["auto", "cpu", "cuda"]),
    (["presets", "show", "gau"], ["gauntlet", "gauntlet_inertial"]),
    (["presets", "show", "train/p"], ["train/paper", "train/policy", "train/ppo"]),
]  # fmt: skip


def test_the_shell_is_offered_names_and_folders(runs, tmp_path_factory):
    cases = [([], completion(words)) for words, _ in OFFERED]
    found = ended(tmp_path_factory.mktemp("completion"), cases, runs)
    for (words, offers), (out, _code, modules) in zip(OFFERED, found, strict=True):
        assert out.split() == offers and not HEAVY & modules, words


def test_completion_can_be_asked_for():
    named = {name for parameter in COMMANDS[()].params for name in parameter.opts}
    assert {"--show-completion", "--install-completion"} <= named


def test_everything_that_can_be_shown_is_offered():
    assert set(parsing.shown("")) == {name for kind in KINDS for name in preset_names(kind)} | {
        f"{kind}/" for kind in KINDS
    }


def test_a_folder_that_cannot_be_read_offers_nothing(tmp_path):
    assert parsing.presets("world")(f"{tmp_path}/no/such/") == []
