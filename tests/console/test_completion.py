"""The command line answers quickly: what help, completion and light commands import, what is offered."""

import os
import re
import shlex
import subprocess
import sys

import pytest

from docs.writers import commands
from tests.command import uuv
from tests.repository.test_docs import fault
from uuvtai.common.presets import KINDS, preset_names
from uuvtai.console import parsing

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


def modules_after(*arguments, **environment):
    """(exit code, modules loaded) of a command in a process of its own."""
    program = (
        "import sys\nfrom uuvtai.cli import main\n"
        f"try: main({list(arguments)})\nexcept SystemExit as left: print('left', left.code, *sys.modules, "
        "file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    _left, code, *modules = done.stderr.splitlines()[-1].split()
    return int(code), set(modules)


@pytest.mark.parametrize(
    "arguments", [["show", "bt"], ["show", "planner", "--dot"], ["show", "bt", "--json"]]
)
def test_a_tree_is_printed_without_torch_and_taichi(arguments):
    code, modules = modules_after("presets", *arguments)
    assert code == 0
    assert not {"torch", "taichi", "cv2"} & modules


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


def completed(words, cwd, shell="bash"):
    """What the shell is offered after these words, the last half-typed; and the modules that it took."""
    program = (
        "import sys\nfrom uuvtai.cli import main\ntry: main()\nfinally: print(*sys.modules, file=sys.stderr)"
    )
    environment = os.environ | {
        "_UUV_COMPLETE": f"complete_{shell}", "COMP_WORDS": "uuv " + " ".join(words),
        "COMP_CWORD": str(len(words)),
        "_TYPER_COMPLETE_ARGS": "uuv " + " ".join(words),
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, env=environment, cwd=cwd
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done.stdout.split(), set(done.stderr.split())


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


@pytest.mark.parametrize(("words", "offers"), [
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
], ids=" ".join)  # fmt: skip
def test_the_shell_is_offered_names_and_folders(words, offers, runs):
    found, modules = completed(words, runs)
    assert found == offers
    assert not HEAVY & modules


def test_completion_is_shown_for_a_shell():
    code = (
        "from typer.completion import get_completion_script as s; print(s(prog_name='uuv', "
        "complete_var='_UUV_COMPLETE', shell='bash'))"
    )
    wanted = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "_UUV_COMPLETE=complete_bash" in wanted
    for option in ("--show-completion", "--install-completion"):
        assert option in {name for parameter in COMMANDS[()].params for name in parameter.opts}


def test_everything_that_can_be_shown_is_offered():
    assert set(parsing.shown("")) == {name for kind in KINDS for name in preset_names(kind)} | {
        f"{kind}/" for kind in KINDS
    }


def test_a_folder_that_cannot_be_read_offers_nothing(tmp_path):
    assert parsing.presets("world")(f"{tmp_path}/no/such/") == []


@pytest.mark.parametrize(
    "arguments",
    [
        *(["--version"], ["--help"], ["eval", "-h"], ["log", "-h"]),
        *(["presets"], ["presets", "show", "sensors/paper", "--json"]),
    ],
)
def test_help_and_presets_import_little(arguments):
    code, modules = modules_after(*arguments)
    assert code == 0
    light = {"yaml"} if arguments[0] == "presets" else set()
    assert not (HEAVY - light) & modules
