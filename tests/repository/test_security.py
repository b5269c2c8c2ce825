"""No file can make uuv execute code, fill the memory, or write outside its folder by being opened: each way
is tried, in one table for each format.

Every attack that executes would leave the file ``executed`` behind. Bombs are checked by what refuses them:
without it they would run for hours or take all memory.
"""

import ast
import base64
import functools
import io
import json
import os
import pickle
import re
import shutil
import struct
import time
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import save as safetensors_bytes

from tests import report_samples as samples
from tests.command import Quiet, run_cli
from tests.learning.export import test_deploy as deployed
from tests.learning.test_checkpoint import rewritten
from tests.logs.test_hostile_logs import END, chunk_of
from tests.oracles import logs as episode
from uuvtai.common.errors import UserError
from uuvtai.config.loader import ConfigError, _SafeLoader, load_config, load_resolved, parsed_yaml
from uuvtai.evaluation.evaluate import evaluate_now
from uuvtai.evaluation.reproduce import resume as resume_reproduction
from uuvtai.evaluation.sweep import resume as resume_sweep
from uuvtai.learning import checkpoint
from uuvtai.learning.checkpoint import CheckpointError, config_sha256
from uuvtai.learning.export import run_policy
from uuvtai.learning.export.folder import of_onnx
from uuvtai.learning.policy_agent import load_agent
from uuvtai.learning.runner import MetricsRecorder, TrainRequest, train
from uuvtai.logs.container import McapFile
from uuvtai.logs.drawing import load_recording
from uuvtai.logs.encode import LogError
from uuvtai.logs.picture import picture
from uuvtai.logs.run_folder import RunFolder, RunFolderError
from uuvtai.logs.topics.sensors import logged_image
from uuvtai.report.build import media, report
from uuvtai.sim.behavior_tree import TreeError, parse_tree

PACKAGE = Path(__file__).parents[2] / "uuvtai"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder to work in; nothing may have been executed when the test is over."""
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    assert not (tmp_path / "executed").exists(), "a file was executed"


@pytest.fixture
def told(capfd):
    """A function that runs a command, which must refuse in one line; the line."""

    def one_line(*arguments):
        assert run_cli(*arguments) == 2
        answer = capfd.readouterr()
        assert answer.out == "" and "Traceback" not in answer.err and len(answer.err) < 1000
        return answer.err

    return one_line


class Exploit:
    """What a pickle may do when it is opened."""

    def __reduce__(self):
        return (open, ("executed", "w"))


PICKLE = pickle.dumps(Exploit())
torch.save(Exploit(), of_torch := io.BytesIO())
PICKLES = {
    "a pickle": PICKLE,
    "an old pickle": pickle.dumps(Exploit(), protocol=0),
    "a pickle of torch.save": of_torch.getvalue(),
}


def test_the_exploit_would_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pickle.loads(PICKLE).close()
    assert (tmp_path / "executed").exists()


# ------------------------------------------------------------------------------------------------ the package

FORBIDDEN = """
eval exec compile __import__ pickle marshal shelve dill joblib runpy tarfile os.system os.popen torch.load
torch.jit.load np.load np.lib.format.read_array
"""
ALONE = {"vehicle/embedded/runtime.py"}
"""file of an exported stack: it runs without uuvtai, out of a folder whose native code is run as it is"""
READERS = {
    "common/files.py": "it is the one reader",
    "report/html.py": "the page's template lies in the package",
    "learning/export/run_policy.py": "it must run without uuvtai and has a reader of its own",
    **dict.fromkeys(ALONE, "it must run without uuvtai, beside native code that it runs"),
}
"""files that may open others themselves, and why"""
OWN_READS = {
    # what they have just written, or what lies in the package
    "logs/video.py": "os.open, av.open",
    "compile/cache.py": "path.read_bytes, json.loads",
    "learning/export/folder.py": "Path(run_policy.__file__).read_bytes",
    "vehicle/embedded/export.py": "out.read_bytes, (_ROOT / name).read_text",
    "console/doctor.py": "source.read_bytes",
    # bytes that the reader has read
    "config/shapes.py": "Image.open",
    # one file of the system, by its name
    "logs/run_folder.py": "cpuinfo.read_text",
    "sim/setup.py": "meminfo.read_text",
    # JSON of this process or its siblings
    "sim/snapshot.py": "json.loads",
    "evaluation/grid.py": "json.loads",
    "learning/checkpoint.py": "json.loads",
    # messages and attachments of a log, each no longer than its MAX_RECORD
    "logs/reader.py": "json.loads",
}
"""files that open or parse by these calls what is no stranger's"""
OPENS = """
open read_text read_bytes readlines fromfile loadtxt genfromtxt memmap imread VideoCapture load_file safe_open
"""
PARSES = {"json.load", "json.loads", "np.load", "torch.load"}


@functools.cache
def package():
    """(name, syntax tree) of every file."""
    paths = sorted(PACKAGE.rglob("*.py"))
    return [(str(path.relative_to(PACKAGE)), ast.parse(path.read_text())) for path in paths]


@functools.cache
def called(call):
    """What a call calls, as text."""
    return ast.unparse(call.func)


def test_nothing_in_the_package_can_execute_what_it_reads():
    """Calls that turn data into code do not occur; YAML is loaded by our own safe loader alone (any other
    call reads numbers to the base of 60, aliases and duplicate keys), NumPy without pickles."""
    found, loaders, importers = [], [], set()
    for name, tree in package():
        for node in ast.walk(tree):
            if isinstance(node, ast.Import | ast.ImportFrom):
                modules = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
                bad = set(FORBIDDEN.split()) & {module.split(".")[0] for module in modules}
                bad |= {"yaml"} & {modules[-1].split(".")[0]}
                found += [f"{name}: import {module}" for module in bad]
            elif isinstance(node, ast.Call):
                call = called(node)
                words = {word.arg: ast.unparse(word.value) for word in node.keywords}
                bad = call in FORBIDDEN.split() and not (name in ALONE and words == {"allow_pickle": "False"})
                bad |= call.startswith("yaml.") and call not in ("yaml.safe_dump", "yaml.MarkedYAMLError")
                bad |= "shell" in words or words.get("allow_pickle", "False") != "False"
                found += [f"{name}:{node.lineno} {call}"] if bad else []
                loaders += [ast.unparse(node)] if call.endswith("Loader") else []
                importers |= {Path(name).name} if call == "importlib.import_module" else set()
    assert not found
    assert loaders == ["_SafeLoader(text)"] and issubclass(_SafeLoader, yaml.SafeLoader)
    assert importers <= {"doctor.py", "__init__.py"}, "modules are never imported by names from files"
    loaders = [path.name for path in PACKAGE.rglob("*.py") if "module_from_spec" in path.read_text()]
    assert loaders == ["loading.py"], "Python of the user's is run in one place, which she has named"


def reads_of(tree):
    """(line, call) of whatever opens or parses a file."""
    imported = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "uuvtai.common.files"
        for alias in node.names
    }
    ours = {"files"} | ({"read_text", "read_bytes", "read_json"} & imported)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            call = called(node)
            last = call.rpartition(".")[2]
            texts = [str(given.value) for given in node.args if isinstance(given, ast.Constant)]
            writes = last == "open" and any(text.startswith("w") for text in texts)
            is_ours = call in ours or call.startswith("files.")
            if (last in OPENS.split() or call in PARSES) and not is_ours and not writes:
                yield node.lineno, call


def test_whatever_is_read_goes_through_the_one_reader():
    """A read that nobody guards hangs on a pipe, fills the memory, or follows a link out of the folder."""
    for name, tree in package():
        if name in READERS:
            continue
        lines = (PACKAGE / name).read_text().splitlines()
        found = {call for line, call in reads_of(tree) if "os.devnull" not in lines[line - 1]}
        assert found <= set(OWN_READS.get(name, "").split(", ")), name


CALLS = """
open('x')  path.open()  Path('x').read_text()  json.load(f)  json.loads(t)  os.open('x',0)  cv2.imread('x')
np.load('x')
"""


@pytest.mark.parametrize("text", CALLS.split())
def test_the_search_for_readers_finds_them(text):
    assert list(reads_of(ast.parse(text)))


# ------------------------------------------------------------------------------------------------------- YAML

TAGS = [
    "world: !!python/object/apply:builtins.open ['executed', 'w']",
    "world: !!python/object/new:builtins.open ['executed', 'w']",
    "world: !!python/name:os.system",
    "!!python/module:os",
    'world: {n_static: !!python/object/apply:eval [\'open("executed", "w")\']}',
    "? !!python/object/apply:builtins.open ['executed', 'w']\n: 1",
]
LAUGHS = [f"{new}: &{new} [{','.join([f'*{old}'] * 9)}]" for old, new in pairwise("abcdefghij")]
YAML = {
    **{text: (text, "could not determine a constructor for the tag") for text in TAGS},
    "billion laughs": ("a: &a [1]\n" + "\n".join(LAUGHS), "aliases"),
    "merged into itself": ("a: &a\n  <<: *a\n", "aliases"),
    "nested": ("[" * 20_000, "recursion"),
    "nested maps": ("a: " + "{a: " * 10_000, "recursion"),
    "a number that a regular expression takes hours over": ("a: " + "1" * 900_000 + "x", "900001 characters"),
    "base 60": ("train:\n  seed: 1" + ":1" * 400_000, "800001 characters"),
    "base 60, not whole": ("a: 1" + ":1" * 200 + ".5", "int too large"),
    "many digits": ("a: " + "9" * 900, "unknown key 'a'"),
    "many values": ("a: [" + "0," * 50_000 + "0]", "more than 50000 values"),
    "a long key": ("k" * 900_000 + ": 1", "900000 characters"),
}


@pytest.mark.parametrize(("text", "says"), YAML.values(), ids=YAML)
def test_yaml(here, text, says):
    """By name, as a run's, and in a page: all by the one loader."""
    run = samples.write_run(here / "run", metrics=samples.metrics(3), config=text)
    file = run / "config.yaml"
    reads = [lambda: load_config(str(file)), lambda: load_resolved(file)]
    reads += [] if "unknown key" in says else [lambda: report([run])]
    for read in reads[: 1 if len(text) > 10_000 else 3]:  # what takes long to refuse is refused once
        with pytest.raises(ConfigError, match=rf"config\.yaml.*{says}"):
            read()


@pytest.mark.parametrize("text", TAGS[:2])
def test_yaml_in_every_command(here, text, told):
    (here / "config.yaml").write_text(text)
    (here / "run.json").write_text("{}")
    commands = [("eval", option, "config.yaml") for option in ("--world", "--sensors", "--vehicle")]
    commands += [("train", "config.yaml"), ("train", "--resume", here)]
    for command in (*commands, ("eval", "--set", f"world.n_static={text.partition(' ')[2]}")):
        assert "not valid YAML" in told(*command) or "--set" in command


def test_yaml_from_elsewhere_is_bounded_too():
    with pytest.raises(ConfigError, match="larger than 1 MiB"):
        parsed_yaml("#" * (2 << 20), "an attachment")


# -------------------------------------------------------------------------------------------------------- XML


def tree_of(body, doctype=""):
    return f'{doctype}<root BTCPP_format="4"><BehaviorTree ID="m">{body}</BehaviorTree></root>'


LAUGH = '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;">]>'
OUTSIDE = '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
PARAMETER = '<!DOCTYPE r [<!ENTITY % x SYSTEM "file:///etc/passwd"> %x;]>'
DTD = "DTDs and entities are not allowed"
CHAIN = "".join(f'<BehaviorTree ID="t{i}"><SubTree ID="t{i + 1}"/></BehaviorTree>' for i in range(5000))
XML = {
    "billion laughs": (tree_of("&c;", LAUGH), DTD),
    "a file from outside": (tree_of("&x;", OUTSIDE), DTD),
    "a DTD from outside": (tree_of("<Hold/>", '<!DOCTYPE r SYSTEM "http://127.0.0.1:9/evil.dtd">'), DTD),
    "parameter entities": (tree_of("<Hold/>", PARAMETER), DTD),
    "an undeclared entity": (tree_of("&x;"), "undefined entity"),
    "nested": (tree_of("<Sequence>" * 100_000), "nested more than"),
    "a long attribute": (tree_of(f'<Hold name="{"ab" * 200_000}"/>'), "attribute longer than"),
    "a long name": (tree_of(f"<{'ab' * 200_000}/>"), "or attribute longer"),
    "large": (tree_of(" " * (2 << 20)), "larger than|more than the 1,048,576 that such a file may have"),
    "subtrees without end": (
        f'<root BTCPP_format="4" main_tree_to_execute="t0">{CHAIN}</root>',
        "are nested",
    ),
    "within itself": (tree_of('<SubTree ID="m"/>'), "contains itself"),
    "many nodes": (tree_of("<Sequence>" + "<Hold/>" * 10_000 + "</Sequence>"), "more than 64 nodes"),
}


@pytest.mark.parametrize(("text", "says"), XML.values(), ids=XML)
def test_xml(here, text, says, told):
    with pytest.raises(TreeError, match=says):
        parse_tree(text)
    (here / "evil.xml").write_text(text)
    answer = told("presets", "show", here / "evil.xml")
    assert re.search(says, answer) and "evil.xml:" in answer and "root:" not in answer


# ------------------------------------------------------------------------------------------------ checkpoints


def forged(path, name, content):
    """Other content for a file of a checkpoint, with the right size and sha256 in the manifest."""
    (path / name).write_bytes(content)
    entry = checkpoint.entry_of(path / name).model_dump()
    rewritten(path, lambda document: document["files"].update({name: entry}))


FILE = {"bytes": 1, "sha256": "0" * 64}
"""an entry of a manifest"""


def linked(file):
    """Replace a file by a link to itself elsewhere."""
    file.symlink_to(file.rename(file.parent.parent / "elsewhere"))


def flipped(file, place):
    content = bytearray(file.read_bytes())
    content[place] ^= 4
    file.write_bytes(content)


def wide(document):
    """Networks of terabytes in a few bytes, whose initial weights would take days."""
    document["config"]["policy"]["hidden"] = [10**6, 10**6]
    document["config_sha256"] = config_sha256(document["config"])


def manifest_as(content):
    return lambda path: (path / "manifest.json").write_bytes(content)


def weights_as(content):
    return lambda path: forged(path, "model.safetensors", content)


def with_manifest(change):
    return lambda path: rewritten(path, change)


def observed_to(stop):
    return with_manifest(lambda document: document["observation_table"][-1].update(stop=stop))


OPENED = {
    "truncated": (lambda p: os.truncate(p / "model.safetensors", 1000), "was cut off"),
    "missing file": (lambda p: (p / "model.safetensors").unlink(), "model.safetensors: is missing"),
    "missing manifest": (lambda p: (p / "manifest.json").unlink(), "manifest.json: is missing"),
    "manifest cut off": (lambda p: os.truncate(p / "manifest.json", 100), "cannot be read"),
    "manifest is no JSON": (manifest_as(b"\x80\x04\x95"), "cannot be read"),
    **{f"manifest is {name}": (manifest_as(x), "manifest.json: cannot be") for name, x in PICKLES.items()},
    "manifest nested without end": (manifest_as(b"[" * 100_000), "cannot be read"),
    "manifest of something else": (manifest_as(b'{"a": 1}'), "is not a manifest"),
    "huge manifest": (manifest_as(b" " * (9 << 20)), "more than the 8,388,608 that such a file may have"),
    "NaN": (with_manifest(lambda d: d.update(step=float("nan"))), "NaN"),
    "other schema": (with_manifest(lambda d: d.update(schema=2)), "has schema 2, this uuvtai reads 1"),
    "newer version": (with_manifest(lambda d: d.update(version="9.9.0")), "was written by uuvtai 9.9.0"),
    "no version": (with_manifest(lambda d: d.pop("version")), "was written by uuvtai None"),
    "unknown key": (with_manifest(lambda d: d.update(run="rm")), "run: Extra inputs"),
    "changed config": (with_manifest(lambda d: d["config"]["ppo"].update(gamma=0.5)), "sha256"),
    "unknown config key": (with_manifest(lambda d: d["config"].update(extra=1)), "extra: Extra inputs"),
    "unlisted file": (with_manifest(lambda d: d["files"].pop("training.safetensors")), "is not listed"),
    "path trick": (with_manifest(lambda d: d["files"].update({"../../x": FILE})), "'../../x', which no"),
    "absolute path": (with_manifest(lambda d: d["files"].update({"/etc/passwd": FILE})), "no checkpoint has"),
    "link": (lambda p: linked(p / "model.safetensors"), "is a link"),
    **{
        f"bit {at} of {name}": (lambda p, name=name, at=at: flipped(p / name, at), f"{name}: is damaged")
        for name in ("model.safetensors", "training.safetensors", "simulator.zst")
        for at in (0, 9, -1)
    },
}
"""refused before anything is used"""
NEVER = "is not a safetensors file .* pickles and other formats are never opened"
OTHERS = "its networks are not those of its config"
USED = {
    **{name: (weights_as(content), f"model.safetensors: {NEVER}") for name, content in PICKLES.items()},
    "other tensors": (weights_as(safetensors_bytes({"other": torch.zeros(1)})), "does not fit together"),
    "wider networks than their file": (with_manifest(wide), r"instead of \(1000000, 42\)"),
    "endless observations": (observed_to(10**9), OTHERS),
    "many observations": (observed_to("many"), OTHERS),
    "no observations": (observed_to(None), OTHERS),
}
"""refused before a network is made"""


@pytest.mark.parametrize("name", [*OPENED, *USED])
def test_a_checkpoint(here, name, told):
    damage, says = (OPENED | USED)[name]
    path = deployed.saved(here / "run").path
    damage(path)
    with pytest.raises(CheckpointError, match=says) as error:
        found = checkpoint.open_checkpoint(path)
        assert name in USED
        load_agent(found, 1)
    assert str(path) in str(error.value), "the message says where"
    if "pickle" in name or name in ("truncated", "link", "path trick", "endless observations"):
        answer = told("export", path) + told("eval", path)
    if "pickle" in name:
        assert ("manifest.json" if name in OPENED else "model.safetensors") in answer


# ------------------------------------------------------------------------------------------------ run folders

WRITTEN = """
.lock run.json config.yaml metrics.jsonl cells.jsonl sweep.json sweep_request.json reproduce.json report.html
profile.json checkpoints checkpoints/step_000002 checkpoints/step_000002/model.safetensors
checkpoints/.partial-step_000003.1 eval eval/result.json eval/tree.json eval/trees eval/trees/bt.xml figures
figures/agents.png pictures pictures/x.png explain explain/x.png logs logs/x.mcap
tensorboard tensorboard/events.out.tfevents.1 anything/else
"""
"""what a run folder may hold, and what a resumed run, a report or an evaluation writes or deletes there"""
READERS_OF_A_RUN = {
    "held": RunFolder.held,
    "train --resume": lambda run: train(TrainRequest(resume=run), Quiet(), evaluate_now),
    "sweep --resume": lambda run: resume_sweep(run, None, Quiet()),
    "reproduce --resume": lambda run: resume_reproduction(run, Quiet()),
    "report": lambda run: report([run]),
    "report --out": lambda run: report([run], run.parent / "new.html"),
    "several": lambda run: report([run, run], run.parent / "new.html", force=True),
}


@pytest.fixture
def run(here):
    """A folder of a training."""
    return samples.write_run(here / "run", metrics=samples.metrics(3), sweep=samples.noise_sweep())


@pytest.fixture
def outside(here):
    """A folder elsewhere that nobody may touch."""
    for name in ("file", "agents.png", "result.json", "manifest.json", "step_000001/manifest.json",
                 ".partial-x/model.safetensors"):  # fmt: skip
        file = here / "outside" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text('{"iteration": 9}\n{"cut')
    before = everything(here / "outside")
    yield here / "outside"
    assert everything(here / "outside") == before


def everything(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def place(path, make):
    """Put something else where a file was or may be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    make(path)


@pytest.mark.parametrize("name", WRITTEN.split())
@pytest.mark.parametrize("open_it", READERS_OF_A_RUN.values(), ids=READERS_OF_A_RUN)
def test_a_link_in_a_run_folder_is_neither_read_nor_written_nor_deleted_through(run, outside, name, open_it):
    is_file = "." in Path(name).name.lstrip(".") or name == ".lock"
    place(run / name, lambda link: link.symlink_to(outside / "file" if is_file else outside))
    with pytest.raises(UserError, match=r"is a link|no plain file run\.json"):
        open_it(run)
    assert sorted(path.name for path in run.parent.iterdir()) == ["outside", "run"]


def test_a_picture_that_is_a_link_is_never_embedded(run, outside):
    place(run / "pictures/x.png", lambda link: link.symlink_to(outside / "file"))
    with pytest.raises(UserError, match="is a link"):
        media(run, None)


def test_a_checkpoint_is_not_written_into_a_folder_elsewhere(run, outside):
    (run / "checkpoints").symlink_to(outside)
    with pytest.raises(CheckpointError, match="is a link"):
        deployed.saved(run)
    with pytest.raises(CheckpointError, match="no usable checkpoint"):
        checkpoint.best(run)


def test_a_sweep_takes_the_lock_before_it_touches_anything(run):
    """The last line of cells.jsonl was cut off before anybody had looked whose file it is."""
    (run / "cells.jsonl").write_text('{"S": 1}\n{"S": 2')
    holder = RunFolder.held(run)
    with pytest.raises(RunFolderError, match="another process is working in this folder"):
        resume_sweep(run, None, Quiet())
    assert (run / "cells.jsonl").read_text() == '{"S": 1}\n{"S": 2'
    holder.release()


def test_files_with_a_second_name_are_not_written_in_place(run, here):
    (here / "copy.jsonl").hardlink_to(run / "metrics.jsonl")
    before = (here / "copy.jsonl").read_bytes()
    with pytest.raises(UserError, match="has a second name"):
        MetricsRecorder(run, 1)
    assert (here / "copy.jsonl").read_bytes() == before


FILLS = {
    "pipe": os.mkfifo,
    "endless link": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
    "sparse": lambda path: path.touch() or os.truncate(path, 1 << 40),
}
"""places that cannot be read to their end, or that never answer"""
READ = """
run.json config.yaml metrics.jsonl sweep.json profile.json reproduce.json eval/result.json
checkpoints/step_000001/manifest.json
"""
SHOWN = "pictures/x.png explain/x.png"
"""a large one is left out of a page"""


@pytest.mark.parametrize(
    ("name", "kind"), [*product(READ.split(), FILLS), *product(SHOWN.split(), list(FILLS)[:3])]
)
def test_a_report_waits_for_nothing_and_reads_nothing_endless(run, name, kind):
    place(run / name, FILLS[kind])
    begun = time.monotonic()
    with pytest.raises(UserError, match=re.escape(Path(name).name)):
        report([run])
    assert time.monotonic() - begun < 10
    assert not (run / "report.html").exists()


UNUSABLE = {
    "nothing": b"",
    "a list": b"[]",
    "a number": b"3",
    "an endless list": b"[" * 200_000,
    "deep": b'{"argv": ' + b"[" * 10_000 + b"]" * 10_000 + b"}",
    "deep objects": b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
    "a million lists": b'{"argv": [' + b"[]," * 2_000_000 + b"[]]}",
    "a pickle": PICKLE,
    "not UTF-8": b'{"started": "\xff"}',
    "half a character": b'{"started": "\\ud800"}',
    "infinite": b'{"wall_s": 1e999}',
    "NaN": b'{"wall_s": NaN}',
    "many digits": b'{"wall_s": ' + b"9" * 4000 + b"}",
    "wall_s": b'{"wall_s": [1]}',
    "wall_s as a word": b'{"wall_s": "long"}',
    "resumed": b'{"resumed": 3}',
    "resumed as an object": b'{"resumed": {"a": 1}}',
}
"""records of a run that cannot be gone on with"""
ODD = {
    "argv": b'{"argv": 3}',
    "argv of lists, status": b'{"argv": [[1], {"a": 2}, null], "status": {"a": []}}',
    "hardware": b'{"hardware": 3, "versions": "none"}',
    "hardware as a list": b'{"hardware": ["cpu"]}',
    "seeds": b'{"seeds": 7}',
    "seeds null": b'{"seeds": null}',
    "resumed by numbers": b'{"resumed": [3]}',
}


@pytest.mark.parametrize("name", [*UNUSABLE, *ODD])
def test_the_record_of_a_run(run, name):
    """It may lack anything; what it has must be what it says it is: a page or one line."""
    (run / "run.json").write_bytes((UNUSABLE | ODD)[name])
    both = [([run, run], run.parent / "both.html")] if name in list(ODD)[:2] else []
    for runs, out in (([run], None), *both):
        try:
            report(runs, out)
        except UserError as error:
            assert "\n" not in str(error) and len(str(error)) < 1000
    if name in UNUSABLE:
        with pytest.raises(RunFolderError, match=r"run\.json: cannot be read"):
            RunFolder.held(run).go_on({})


def use_of(tree="bt", **node):
    return json.dumps({"use": {tree: [{"share": 1, "ticks": 1, "acted": 1} | node]}}).encode()


BEYOND = "is beyond what a number holds"
EVALUATIONS = {
    "a pickle": (PICKLE, "tree.json"),
    "nested": (b"[" * 200_000, "tree.json"),
    "a list": (b"[]", "tree.json"),
    "a number for all": (b'{"use": 3}', "tree.json"),
    "a word for a number": (use_of(share="much"), "tree.json"),
    "an endless share": (b'{"use": {"bt": [{"share": 1e999, "ticks": 1, "acted": 1}]}}', BEYOND),
    "endless ticks": (b'{"use": {"bt": [{"share": 1, "ticks": 1e999, "acted": 1}]}}', BEYOND),
    "../../secret": (use_of("../../secret"), "does not lie in"),
    "/etc/passwd": (use_of("/etc/passwd"), "does not lie in"),
    "link": (use_of("link"), "is a link"),
}


@pytest.mark.parametrize("name", EVALUATIONS)
def test_the_trees_of_an_evaluation(here, name, told):
    content, says = EVALUATIONS[name]
    (here / "run/eval/trees").mkdir(parents=True)
    (here / "secret.xml").write_text((PACKAGE / "presets/trees/straight.xml").read_text())
    (here / "run/eval/trees/link.xml").symlink_to(here / "secret.xml")
    (here / "run/eval/tree.json").write_bytes(content)
    assert says in told("presets", "show", name if use_of(name) == content else "bt", "--run", here / "run")


# ------------------------------------------------------------------------------------------ exported policies


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    return deployed.without_graph(tmp_path_factory.mktemp("export"))[0]


@pytest.fixture
def folder(exported, here):
    return Path(shutil.copytree(exported, here / "out"))


def with_header(header, data=b""):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def array(shape, stop, dtype="F32", names="a"):
    return {name: {"dtype": dtype, "shape": shape, "data_offsets": [0, stop]} for name in names}


WEIGHTS = {
    "empty": b"",
    "a pickle": b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00\x8c\x02os\x94",
    "header beyond the file": (1 << 62).to_bytes(8, "little") + b"{}",
    "no JSON": with_header(b"{nonsense"),
    "nested without end": with_header(b"[" * 100_000),
    "a list": with_header([1]),
    "beyond the data": with_header(array([4], 16), bytes(8)),
    "overlapping": with_header(array([2], 8, names="ab"), bytes(16)),
    "shape unlike bytes": with_header(array([1 << 40, 1 << 40], 8), bytes(8)),
    "negative": with_header(array([-1, -2], 8), bytes(8)),
    "objects": with_header(array([1], 8, "O"), bytes(8)),
    "too much data": with_header(array([1], 4), bytes(8)),
    "NaN": with_header(array([1], 4), np.float32("nan").tobytes()),
}
NETWORKS = [
    lambda arrays: arrays.pop("actor.0.bias"),
    lambda arrays: arrays.update({"actor.0.weight": arrays["actor.0.weight"][:, 1:]}),
    lambda arrays: arrays.update({f"critic.4.{of}": arrays[f"actor.4.{of}"] for of in ("weight", "bias")}),
    lambda arrays: arrays.update({"decoder.2.bias": arrays["decoder.2.bias"][:5]}),
    lambda arrays: arrays.clear(),
]


SPECS = {
    b"{": "is not JSON",
    b"[" * 100_000: "is not JSON",
    b"[]": "is not the specification",
    b'{"schema": 5}': "is not the specification of an exported policy of schema 6",
    b'{"schema": 6, "files": {}}': "lists other files",
}
STRANGE = ["../../etc/passwd", "/etc/passwd", "sub/policy.onnx"]


def listing(name):
    """Another file in the specification."""

    def listed(file):
        spec = json.loads(file.read_text())
        spec["files"][name] = "0" * 64
        file.write_text(json.dumps(spec))

    return listed


def with_networks(change):
    def changed(file):
        arrays = {name: array.copy() for name, array in run_policy.read_safetensors(file).items()}
        change(arrays)
        file.write_bytes(safetensors_bytes({name: torch.from_numpy(x.copy()) for name, x in arrays.items()}))

    return changed


def written(content):
    return lambda file: file.write_bytes(content)


POLICIES = [
    *((run_policy.WEIGHTS, written(content), "is not a safetensors file") for content in WEIGHTS.values()),
    *((run_policy.WEIGHTS, with_networks(change), "do not fit together") for change in NETWORKS),
    *((run_policy.GOLDEN, written(w), "is not a safetensors file") for n, w in WEIGHTS.items() if n != "NaN"),
    *((run_policy.SPEC, written(text), says) for text, says in SPECS.items()),
    *((run_policy.SPEC, listing(name), "lists other files") for name in STRANGE),
]


@pytest.mark.parametrize(("name", "spoil", "says"), POLICIES)
def test_an_exported_policy(folder, name, spoil, says, told):
    spoil(folder / name)
    if name != run_policy.SPEC:
        deployed.resigned(folder, name, (folder / name).read_bytes())
    if name == run_policy.GOLDEN or not says.startswith("is not a"):
        assert says in told("export", "--check", folder)
    if name != run_policy.GOLDEN:  # driving does not need them
        with pytest.raises(run_policy.PolicyError, match=says):
            run_policy.load(folder)


def test_links_out_of_an_exported_folder_are_not_followed(folder):
    linked(folder / run_policy.GOLDEN)
    with pytest.raises(run_policy.PolicyError, match="no plain file"):
        run_policy.load(folder)


def test_the_driver_of_a_folder_is_never_executed_by_its_check(folder):
    deployed.resigned(folder, "run_policy.py", b"open('executed', 'w')")
    assert run_cli("export", "--check", folder) == 0


def test_graphs_that_reach_beyond_themselves_are_refused():
    onnx = pytest.importorskip("onnx", reason="needs the extra uuvtai[export]")
    helper, tensor = onnx.helper, onnx.TensorProto
    value = helper.make_tensor_value_info("obs", tensor.FLOAT, [1])
    outside = onnx.TensorProto(
        name="w", data_type=tensor.FLOAT, dims=[1], data_location=onnx.TensorProto.EXTERNAL
    )
    outside.external_data.add(key="location", value="../../etc/passwd")
    body = helper.make_graph([], "b", [], [])
    pairs = {
        f"pair_{name}": np.zeros((2, 4), np.float32)
        for name in ("obs", "last_obs", "last_action", "has_last")
    }
    graphs = {
        "evil.Run": helper.make_graph(
            [helper.make_node("Run", ["obs"], ["out"], domain="evil")], "g", [value], []
        ),
        "onnx.Loop": helper.make_graph([helper.make_node("Loop", ["", ""], [], body=body)], "g", [value], []),
        "has w": helper.make_graph([], "g", [value], [], initializer=[outside]),
    }
    for says, graph in graphs.items():
        with pytest.raises(RuntimeError, match=says):
            of_onnx(
                helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)]).SerializeToString(),
                pairs,
                run_policy.Policy.inputs,
            )
    with pytest.raises(RuntimeError, match="is no ONNX graph"):
        of_onnx(PICKLE, pairs, run_policy.Policy.inputs)


# ------------------------------------------------------------------------------------------------------- logs


COMMANDS = (
    ("log", "info"),
    ("log", "export", "--out", "out"),
    ("log", "repair"),
    ("log", "render", "--out", "a.png"),
    ("log", "render", "--out", "a.mp4"),
    ("log", "convert"),
)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[1])
def test_chunks_that_unfold(here, command, capfd):
    """200 MiB of zeros in 20 kB, by every command; by the reader alone: ``test_hostile_logs.py``."""
    if command[1] == "convert":
        pytest.importorskip("rosbags", reason="needs the extra uuvtai[ros]")
    bomb = chunk_of(bytes(200 << 20))
    file = McapFile(here / "a.mcap")
    file.add_attachment("scenario.json", "application/json", json.dumps(episode.scenario()).encode())
    file.leave()
    (here / "a.mcap").write_bytes(file.part.read_bytes() + bomb + END)
    file.part.unlink()
    assert run_cli(*command[:2], here / "a.mcap", *command[2:]) == 2
    assert "unpack" in capfd.readouterr().err
    assert {path.name for path in here.rglob("*") if path.is_file()} == {"a.mcap"}


def test_names_of_attachments_and_topics_stay_inside(here, capfd):
    names = [
        "../../evil", "/tmp/evil_absolute", "..\\..\\evil", "a/../../b", "..", ".", "", "\0x", "C:\\evil",
        "~/.bashrc", "x\n--flag",
    ]  # fmt: skip
    file = McapFile(here / "a.mcap")
    for name in names:
        file.add_attachment(name, "text/plain", b"x")
        file.add_message(
            file.add_channel(f"/{name}", file.add_schema("s", "jsonschema", b"{}")), 0, b'{"x": 1}'
        )
    file.finish()
    assert run_cli("log", "export", here / "a.mcap", "--out", here / "deep" / "out") == 0
    written = {path for path in here.rglob("*") if path.is_file()} - {here / "a.mcap"}
    out = here / "deep" / "out"
    assert {path.parent for path in written} == {out, out / "attachments"}
    assert not any(path.name.startswith((".", "-", "~")) for path in written)
    capfd.readouterr()


def log_with(path, scenario=None, attachments=(), poses=((0.0, 1.0),)):
    """A log with a scenario and poses (time [s], x)."""
    file = McapFile(path)
    file.add_attachment(
        "scenario.json", "application/json", json.dumps(scenario or episode.scenario()).encode()
    )
    for name, data in attachments:
        file.add_attachment(name, "", data)
    channel = file.add_channel("/pose", file.add_schema("foxglove.PoseInFrame", "jsonschema", b"{}"))
    for time_s, x in poses:
        pose = {"position": {"x": x, "y": 1.0, "z": -1.0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
        file.add_message(channel, int(time_s * 1e9), json.dumps({"pose": pose}).encode())
    file.finish()
    return path


def changed(**keys):
    return episode.scenario() | keys


DRAWN = {
    "a huge tank": changed(
        tank={"shape": "rectangle", "x_m": [0, 1e9], "y_m": [0, 6], "z_m": [-1, 0], "radius_m": 1}
    ),
    "a tank turned inside out": changed(
        tank={"shape": "rectangle", "x_m": [1, 0], "y_m": [0, 6], "z_m": [-1, 0], "radius_m": 1}
    ),
    "no tank": changed(tank={}),
    "a tank of words": changed(tank={"shape": "rectangle", "x_m": ["a", "b"], "y_m": [0, 6]}),
    "obstacles at the end of the world": changed(
        obstacles=[episode.OBSTACLES[0] | {"position": [1e300, 0, 0]}]
    ),
    "endless obstacles": changed(obstacles=[episode.OBSTACLES[0]] * 100_000),
    "no goal": {key: value for key, value in episode.scenario().items() if key != "goal"},
    "obstacles without shape": changed(obstacles=[{"position": [1, 2, 3]}]),
    "a list": [],
}


@pytest.mark.parametrize("scenario", DRAWN.values(), ids=DRAWN)
def test_scenarios_that_cannot_be_drawn(here, scenario):
    file = McapFile(here / "a.mcap")
    file.add_attachment("scenario.json", "application/json", json.dumps(scenario).encode())
    file.finish()
    log_with(here / "b.mcap", scenario or [0])
    with pytest.raises(LogError, match="drawn"):
        picture(here / "b.mcap", here / "b.png")
    assert not (here / "b.png").exists()


def test_an_episode_that_claims_to_last_for_years(here):
    log_with(here / "a.mcap", poses=((0.0, 1.0), (1e9, 2.0)))
    with pytest.raises(LogError, match=r"claims to last 1e\+09 s"):
        load_recording(here / "a.mcap")


def png(width, height):
    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", len(head)) + b"IHDR" + head + bytes(4)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (png(40_000, 40_000), "claims 40000 x 40000"),
        (png(8, 8), "is damaged"),
        (b"GIF89a", "is not a PNG"),
        (b"", "is not a PNG"),
    ],
)
def test_images_that_unfold(content, says):
    with pytest.raises(LogError, match=says):
        logged_image({"data": base64.b64encode(content).decode()})


@pytest.mark.parametrize("text", TAGS[:3])
def test_a_config_within_a_log_is_yaml_without_tags(here, text, capfd):
    pytest.importorskip("rosbags", reason="needs the extra uuvtai[ros]")
    log_with(here / "a.mcap", attachments=[("config.yaml", text.encode())])
    assert run_cli("log", "convert", here / "a.mcap") == 2
    assert "its config.yaml cannot be read" in capfd.readouterr().err


def test_names_in_a_log_cannot_steer_the_terminal(here, capfd):
    file = McapFile(here / "a.mcap")
    for topic in (
        "/\x1b]52;c;ZXZpbA==\x07", "/[link=file:///etc/passwd]x[/link]", "/[/nothing]", "/\x9b31m\u202e",
    ):  # fmt: skip
        file.add_message(
            file.add_channel(topic, file.add_schema("\x1b[2J", "jsonschema", b"{}")), 0, b"not json"
        )
    file.add_metadata("uuv.result", {"outcome": "\x1b[31m[/x]"})
    file.finish()
    assert run_cli("log", "info", here / "a.mcap") == 0
    assert run_cli("log", "export", here / "a.mcap", "--out", here / "out", "--topic", "\x1b[2J") == 2
    answer = capfd.readouterr()
    assert not any(bad in answer.out + answer.err for bad in ("\x1b", "\x07", "\x9b", "\u202e"))
    assert "[link=file:///etc/passwd]" in answer.out, "shown as it is, not as a link"
