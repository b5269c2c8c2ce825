"""No file can make uuv execute code, fill the memory, or write outside its folder by being opened: each way
is tried.

Every attack that executes would leave the file ``executed`` behind. Bombs are checked by what refuses them:
without it they would run for hours or take all memory.
"""

import ast
import base64
import functools
import json
import os
import pickle
import re
import struct
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
import zstandard

from tests import report_samples as samples
from tests import test_deploy as deployed
from tests.command import run_cli
from tests.reference import logs as episode
from tests.test_hostile_logs import END, chunk_of
from uuvtai.deploy import run_policy, run_set_policy
from uuvtai.deploy.agreement import of_onnx
from uuvtai.errors import UserError
from uuvtai.learn import checkpoint
from uuvtai.learn.checkpoint import CheckpointError
from uuvtai.learn.manifest import config_sha256, sha256_of
from uuvtai.learn.packing import PackingError, read_stream
from uuvtai.learn.pilot import load_pilot
from uuvtai.learn.recorder import MetricsRecorder
from uuvtai.learn.run import TrainRequest, train
from uuvtai.loader import ConfigError, _SafeLoader, load_config, load_resolved, parsed_yaml
from uuvtai.logs.container import McapFile
from uuvtai.logs.log_errors import LogError
from uuvtai.logs.picture import picture
from uuvtai.logs.recording import load_recording
from uuvtai.logs.topics.camera_topics import logged_image
from uuvtai.measure.evaluate.tree_report import tree_report
from uuvtai.measure.evaluate.while_training import evaluate_now
from uuvtai.measure.reproduce.paper_run import resume as resume_reproduction
from uuvtai.measure.sweep.play import resume as resume_sweep
from uuvtai.report.build import report
from uuvtai.report.media import media
from uuvtai.run_folder import RunFolder, RunFolderError
from uuvtai.tree import TreeError, parse_tree, read_tree

PACKAGE = Path(__file__).parent.parent / "uuvtai"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder to work in; nothing may have been executed when the test is over."""
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    assert not (tmp_path / "executed").exists(), "a file was executed"


class Quiet:
    """Watches and says nothing."""

    def __getattr__(self, _name):
        return lambda *_arguments: None


class Exploit:
    """What a pickle may do when it is opened."""

    def __reduce__(self):
        return (open, ("executed", "w"))


@functools.cache
def tree_of(path):
    """A file of the package, parsed once for all tests that search it."""
    return ast.parse(path.read_text())


@functools.cache
def called(call):
    """What a call calls, as text."""
    return ast.unparse(call.func)


def test_the_exploit_would_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pickle.loads(pickle.dumps(Exploit())).close()
    assert (tmp_path / "executed").exists()


def test_nothing_in_the_package_can_execute_what_it_reads():
    """Calls that turn data into code do not occur; YAML is loaded by our own safe loader alone, NumPy without
    pickles."""
    forbidden = {
        "eval",
        "exec",
        "compile",
        "__import__",
        "pickle",
        "marshal",
        "shelve",
        "dill",
        "joblib",
        "os.system",
        "os.popen",
        "torch.load",
    }
    forbidden |= {
        "np.load",
        "yaml.unsafe_load",
        "yaml.full_load",
        "yaml.load_all",
        "torch.jit.load",
        "runpy",
        "tarfile",
    }
    found, yaml_loads, imports = [], [], []
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
                found += [f"{path.name}: import {name}" for name in names if name.split(".")[0] in forbidden]
            elif isinstance(node, ast.Call):
                name = called(node)
                runs_alone = str(path.relative_to(PACKAGE)) in ALONE and ast.unparse(node).endswith(
                    "allow_pickle=False)"
                )
                found += [f"{path.name}:{node.lineno} {name}"] if name in forbidden and not runs_alone else []
                yaml_loads += [ast.unparse(node)] if name == "yaml.load" or name.endswith("Loader") else []
                imports += (
                    [(path.name, ast.unparse(node.args[0]))] if name == "importlib.import_module" else []
                )
                assert not any(word.arg == "shell" for word in node.keywords), f"{path.name}:{node.lineno}"
                assert not any(
                    word.arg == "allow_pickle" and ast.unparse(word.value) != "False"
                    for word in node.keywords
                )
    assert not found
    assert yaml_loads == ["_SafeLoader(text)"] and issubclass(_SafeLoader, yaml.SafeLoader)
    assert {name for name, _ in imports} <= {"doctor.py", "__init__.py"}, (
        "modules are never imported by names from files"
    )
    loaders = [path.name for path in PACKAGE.rglob("*.py") if "module_from_spec" in path.read_text()]
    assert loaders == ["piece_loading.py"], "Python of the user's is run in one place, which she has named"


ALONE = {"aboard/carried_stack.py", "aboard/stack_check.py"}
"""files of an exported stack: they run without uuvtai, out of a folder whose native code is run as it is"""
READERS = {
    "files.py": "it is the one reader",
    "report/page.py": "the page's template lies in the package",
    "deploy/run_policy.py": "it must run without uuvtai and has a reader of its own",
    **dict.fromkeys(ALONE, "it must run without uuvtai, beside native code that it runs"),
}
"""files that may open others themselves, and why"""
SYSTEM = {"run_folder.py": "/proc/cpuinfo", "sizes.py": "/proc/meminfo"}
"""files that read one file of the system, by its name"""
OWN_FILES = {
    "logs/film.py": "os.open, av.open",
    "native/keys.py": "path.read_bytes",
    "deploy/export.py": "Path(module.__file__ or '').read_bytes",
    "aboard/cross.py": "out.read_bytes",
    "aboard/stack_folder.py": "(_ROOT / name).read_text",
    "example_files.py": "source.read_bytes",
}
"""files that open what they have just written, or what lies in the package, by these calls"""
OPENS = {
    "open",
    "read_text",
    "read_bytes",
    "readlines",
    "fromfile",
    "loadtxt",
    "genfromtxt",
    "memmap",
    "imread",
    "VideoCapture",
    "load_file",
    "safe_open",
}
PARSES = {"json.load", "json.loads", "np.load", "io.open", "os.open", "open", "torch.load"}
OWN_JSON = {
    "capture.py",
    "measure/sweep/plan.py",
    "native/reads.py",
}
"""files whose JSON comes from this process or its siblings, not from a file"""
BOUNDED_JSON = {"logs/reader.py"}
"""files whose JSON are messages and attachments of a log, each no longer than its ``MAX_RECORD``"""


def reads_of(tree):
    """(line, call) of whatever opens or parses a file."""
    imported = {
        alias.asname or alias.name
        for n in ast.walk(tree)
        if isinstance(n, ast.ImportFrom) and n.module == "uuvtai.files"
        for alias in n.names
    }
    ours = {"files"} | ({"read_text", "read_bytes", "read_json"} & imported)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = called(node)
            last = name.rpartition(".")[2]
            writes = last == "open" and any(
                isinstance(a, ast.Constant) and str(a.value).startswith("w") for a in node.args
            )
            if (
                name not in ours
                and not name.startswith("files.")
                and not writes
                and (last in OPENS or name in PARSES)
            ):
                yield node.lineno, name


def test_whatever_is_read_goes_through_the_one_reader():
    """A read that nobody guards hangs on a pipe, fills the memory, or follows a link out of the folder."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        name = str(path.relative_to(PACKAGE))
        if name in READERS:
            continue
        for line, call in reads_of(tree_of(path)):
            system = name in SYSTEM and SYSTEM[name] in path.read_text() and call.endswith(".read_text")
            own = name in OWN_JSON | BOUNDED_JSON and call == "json.loads"
            own |= call in OWN_FILES.get(name, "").split(", ")
            devnull = "os.devnull" in path.read_text().splitlines()[line - 1]
            found += [] if system or own or devnull else [f"{name}:{line} {call}"]
    assert found == []


@pytest.mark.parametrize(
    "text",
    [
        "open('x')",
        "path.open()",
        "Path('x').read_text()",
        "json.load(f)",
        "json.loads(t)",
        "os.open('x', 0)",
        "cv2.imread('x')",
        "np.load('x')",
    ],
)
def test_the_search_for_readers_finds_them(text):
    assert list(reads_of(ast.parse(text)))


def test_yaml_is_loaded_in_one_place():
    """Any other call of the package yaml reads numbers to the base of 60, aliases and duplicate keys."""
    allowed = {
        "loader.py": {"yaml.load(text, Loader=_SafeLoader)", "yaml.compose(text, Loader=_SafeLoader)"},
    }
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text()
        found = ast.walk(tree_of(path)) if "yaml" in text else ()
        calls = {ast.unparse(node) for node in found if isinstance(node, ast.Call)}
        reads = {call for call in calls if re.match(r"yaml\.(?!safe_dump\b|MarkedYAMLError\b)", call)}
        assert reads <= allowed.get(str(path.relative_to(PACKAGE)), set()), path
        assert "from yaml" not in text, path


# ------------------------------------------------------------------------------------------------------- YAML

TAGS = [
    "world: !!python/object/apply:builtins.open ['executed', 'w']",
    "world: !!python/object/new:builtins.open ['executed', 'w']",
    "world: !!python/name:os.system",
    "!!python/module:os",
    'world: {n_static: !!python/object/apply:eval [\'open("executed", "w")\']}',
    "? !!python/object/apply:builtins.open ['executed', 'w']\n: 1",
]


@pytest.mark.parametrize("text", TAGS)
def test_yaml_tags_are_refused_in_every_kind_of_file(here, text, capfd):
    file = here / "evil.yaml"
    file.write_text(text)
    for option in ("--world", "--sensors", "--vehicle"):
        assert run_cli("eval", option, file) == 2
    assert run_cli("train", file) == 2
    assert run_cli("eval", "--set", f"world.n_static={text.partition(' ')[2]}") == 2
    (here / "config.yaml").write_text(text)
    (here / "run.json").write_text("{}")
    assert run_cli("train", "--resume", here) == 2
    assert capfd.readouterr().err.count("not valid YAML") >= 5
    for load in (lambda: load_config(str(file)), lambda: load_resolved(file)):
        with pytest.raises(ConfigError, match="not valid YAML"):
            load()


YAML_BOMBS = {
    "billion laughs": "a: &a [1]\n"
    + "\n".join(f"{chr(98 + i)}: &{chr(98 + i)} [{','.join([f'*{chr(97 + i)}'] * 9)}]" for i in range(9)),
    "merged into itself": "a: &a\n  <<: *a\n",
    "nested": "[" * 200_000,
    "nested maps": "a: " + "{a: " * 100_000,
    "a number that a regular expression takes hours over": "a: " + "1" * 900_000 + "x",
    "base 60": "a: 1" + ":1" * 400_000,
    "base 60, not whole": "a: 1" + ":1" * 200 + ".5",
    "many digits": "a: " + "9" * 900,
    "a million values": "a: [" + "0," * 500_000 + "0]",
    "a long key": "k" * 900_000 + ": 1",
}


@pytest.mark.parametrize("text", YAML_BOMBS.values(), ids=YAML_BOMBS)
def test_yaml_bombs(here, text):
    (here / "bomb.yaml").write_text(text)
    with pytest.raises(ConfigError):
        load_config(str(here / "bomb.yaml"))


def test_yaml_from_elsewhere_is_bounded_too():
    with pytest.raises(ConfigError, match="larger than 1 MiB"):
        parsed_yaml("#" * (2 << 20), "an attachment")


# -------------------------------------------------------------------------------------------------------- XML

TREE = '<root BTCPP_format="4"><BehaviorTree ID="m">{}</BehaviorTree></root>'
ENTITIES = {
    "billion laughs": '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;">]>'
    + TREE.format("&c;"),
    "a file from outside": '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]>' + TREE.format("&x;"),
    "a DTD from outside": '<!DOCTYPE r SYSTEM "http://127.0.0.1:9/evil.dtd">' + TREE.format("<FollowRoute/>"),
    "parameter entities": '<!DOCTYPE r [<!ENTITY % x SYSTEM "file:///etc/passwd"> %x;]>'
    + TREE.format("<FollowRoute/>"),
    "an undeclared entity": TREE.format("&x;"),
}


@pytest.mark.parametrize("text", ENTITIES.values(), ids=ENTITIES)
def test_xml_entities_are_refused(here, text, capfd):
    (here / "evil.xml").write_text(text)
    assert run_cli("tree", "--controller", here / "evil.xml") == 2
    answer = capfd.readouterr()
    assert answer.out == "" and "root:" not in answer.err and "evil.xml:1" in answer.err


def test_xml_bombs(here):
    chained = "".join(f'<BehaviorTree ID="t{i}"><SubTree ID="t{i + 1}"/></BehaviorTree>' for i in range(5000))
    bombs = {
        "nested more than": TREE.format("<Sequence>" * 100_000),
        "attribute longer than": TREE.format(f'<FollowRoute name="{"ab" * 200_000}"/>'),
        "or attribute longer": TREE.format(f"<{'ab' * 200_000}/>"),
        "larger than": TREE.format(" " * (2 << 20)),
        "subtrees are nested": f'<root BTCPP_format="4" main_tree_to_execute="t0">{chained}</root>',
        "contains itself": TREE.format('<SubTree ID="m"/>'),
        "more than 64 nodes": TREE.format("<Sequence>" + "<FollowRoute/>" * 10_000 + "</Sequence>"),
    }
    for says, text in bombs.items():
        with pytest.raises(TreeError, match=says):
            parse_tree(text)
    (here / "big.xml").write_bytes(b" " * (3 << 20))
    with pytest.raises(TreeError, match="more than the 1,048,576 that such a file may have"):
        read_tree(str(here / "big.xml"))


# ------------------------------------------------------------------------------------------------ checkpoints


def forged(path, name, content):
    """Other content for a file of a checkpoint, with the right size and sha256 in the manifest."""
    (path / name).write_bytes(content)
    rewritten(
        path,
        lambda document: document["files"].update(
            {name: {"bytes": len(content), "sha256": sha256_of(path / name)}}
        ),
    )


def rewritten(path, change):
    document = json.loads((path / "manifest.json").read_text())
    change(document)
    (path / "manifest.json").write_text(json.dumps(document))


def torch_saved(folder):
    torch.save(Exploit(), folder / "m.pt")
    return (folder / "m.pt").read_bytes()


@pytest.mark.parametrize(
    "content",
    [lambda _f: pickle.dumps(Exploit()), torch_saved, lambda _f: pickle.dumps(Exploit(), protocol=0)],
)
@pytest.mark.parametrize("name", ["model.safetensors", "manifest.json"])
def test_a_pickle_as_a_checkpoint(here, name, content, capfd):
    path = deployed.saved(here / "run").path
    if name == "manifest.json":
        (path / name).write_bytes(content(here))
    else:
        forged(path, name, content(here))
    assert run_cli("export", path) == 2
    assert run_cli("eval", path) == 2
    said = capfd.readouterr().err
    assert name in said and "Traceback" not in said


def test_networks_wider_than_their_file_are_refused_before_they_are_made(here):
    """A manifest of a few bytes must not make a network of terabytes, nor one whose initial weights take
    days."""
    path = deployed.saved(here / "run").path

    def wide(document):
        document["config"]["policy"]["hidden"] = [10**6, 10**6]
        document["config_sha256"] = config_sha256(document["config"])

    rewritten(path, wide)
    with pytest.raises(CheckpointError, match=r"instead of \(1000000, 42\)"):
        load_pilot(checkpoint.open_checkpoint(path), 1)


@pytest.mark.parametrize("stop", [10**9, "many", None])
def test_observations_wider_than_the_networks_are_refused(here, stop):
    path = deployed.saved(here / "run").path
    rewritten(path, lambda document: document["observation_table"][-1].update(stop=stop))
    with pytest.raises(CheckpointError, match="its networks are not those of its config"):
        load_pilot(checkpoint.open_checkpoint(path), 1)


def test_a_compressed_simulator_state_cannot_unfold(here):
    with (here / "s.zst").open("wb") as file, zstandard.ZstdCompressor().stream_writer(file) as stream:
        for _ in range(256):
            stream.write(bytes(1 << 20))
    assert (here / "s.zst").stat().st_size < 1 << 16
    with pytest.raises(PackingError, match="more than its layout says"):
        read_stream(here / "s.zst", [("x", "uint8", [1000])])


# ------------------------------------------------------------------------------------------------ run folders


WRITTEN = [
    ".lock", "run.json", "config.yaml", "metrics.jsonl", "cells.jsonl", "sweep.json", "sweep_request.json",
    "reproduce.json", "report.html",
    "profile.json", "checkpoints", "checkpoints/step_000002", "checkpoints/step_000002/model.safetensors",
    "checkpoints/.partial-step_000003.1", "eval", "eval/result.json", "eval/tree.json", "eval/trees",
    "eval/trees/bt.xml", "figures",
    "figures/methods.png", "pictures", "pictures/x.png", "videos", "videos/x.webm", "explain",
    "explain/x.png", "logs", "logs/x.mcap",
    "tensorboard", "tensorboard/events.out.tfevents.1", "anything/else",
]  # fmt: skip
"""what a run folder may hold, and what a resumed run, a report or an evaluation writes or deletes there"""


def precious(here):
    """A folder outside, and a file in it, that nobody may touch."""
    (here / "outside" / "step_000001").mkdir(parents=True)
    (here / "outside" / ".partial-x").mkdir()
    for name in (
        "file",
        "methods.png",
        "result.json",
        "step_000001/manifest.json",
        ".partial-x/model.safetensors",
        "manifest.json",
    ):
        (here / "outside" / name).write_text('{"iteration": 9}\n{"cut')
    return here / "outside", here / "outside" / "file"


def everything(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def with_link(here, name):
    """A run folder where ``name`` is a link to what is precious, and what that was."""
    outside, file = precious(here)
    run = samples.write_run(here / "run", metrics=samples.metrics(3), sweep=samples.noise_sweep())
    link = run / name
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    link.symlink_to(file if "." in link.name.lstrip(".") or name == ".lock" else outside)
    return run, everything(outside)


@pytest.mark.parametrize("name", WRITTEN)
@pytest.mark.parametrize(
    "open_it",
    [
        RunFolder.held,
        lambda run: train(TrainRequest(resume=run), Quiet(), evaluate_now),
        lambda run: resume_sweep(run, None, Quiet()),
        lambda run: resume_reproduction(run, Quiet()),
        lambda run: report([run]),
        lambda run: report([run], run.parent / "new.html"),
        lambda run: report([run, run], run.parent / "new.html", force=True),
    ],
    ids=[
        "held",
        "train --resume",
        "sweep --resume",
        "reproduce --resume",
        "report",
        "report --out",
        "several",
    ],
)
def test_a_link_in_a_run_folder_is_neither_read_nor_written_nor_deleted_through(here, name, open_it):
    run, before = with_link(here, name)
    with pytest.raises(UserError, match=r"is a link|no plain file run\.json"):
        open_it(run)
    assert everything(here / "outside") == before
    assert sorted(path.name for path in here.iterdir()) == ["outside", "run"]


def test_a_sweep_takes_the_lock_before_it_touches_anything(here):
    """The last line of cells.jsonl was cut off before anybody had looked whose file it is."""
    run = samples.write_run(here / "run", metrics=[])
    (run / "cells.jsonl").write_text('{"S": 1}\n{"S": 2')
    holder = RunFolder.held(run)
    with pytest.raises(RunFolderError, match="another process is working in this folder"):
        resume_sweep(run, None, Quiet())
    assert (run / "cells.jsonl").read_text() == '{"S": 1}\n{"S": 2'
    holder.release()


def test_files_with_a_second_name_are_not_written_in_place(here):
    run = samples.write_run(here / "run", metrics=samples.metrics(3))
    (here / "copy.jsonl").hardlink_to(run / "metrics.jsonl")
    before = (here / "copy.jsonl").read_bytes()
    with pytest.raises(UserError, match="has a second name"):
        MetricsRecorder(run, 1)
    assert (here / "copy.jsonl").read_bytes() == before


def test_a_checkpoint_is_not_written_into_a_folder_elsewhere(here):
    outside, _file = precious(here)
    (here / "run").mkdir()
    (here / "run" / "checkpoints").symlink_to(outside)
    before = everything(outside)
    with pytest.raises(CheckpointError, match="is a link"):
        deployed.saved(here / "run")
    with pytest.raises(CheckpointError, match="no usable checkpoint"):
        checkpoint.best(here / "run")
    assert everything(outside) == before


def fill(path, kind):
    """A place that cannot be read to its end, or that never answers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    make = {
        "pipe": lambda: os.mkfifo(path),
        "endless link": lambda: path.symlink_to("/dev/zero"),
        "folder": path.mkdir,
        "sparse": lambda: path.touch() or os.truncate(path, 1 << 40),
    }
    make[kind]()


READ = [
    "run.json",
    "config.yaml",
    "metrics.jsonl",
    "sweep.json",
    "profile.json",
    "reproduce.json",
    "eval/result.json",
]


@pytest.mark.parametrize("kind", ["pipe", "endless link", "folder", "sparse"])
@pytest.mark.parametrize("name", [*READ, "checkpoints/step_000001/manifest.json"])
def test_a_report_waits_for_nothing_and_reads_nothing_endless(here, name, kind):
    run = samples.write_run(here / "run", metrics=samples.metrics(3))
    fill(run / name, kind)
    begun = time.monotonic()
    with pytest.raises(UserError, match=re.escape(name.rpartition("/")[2])):
        report([run])
    assert time.monotonic() - begun < 10
    assert not (run / "report.html").exists()


@pytest.mark.parametrize("kind", ["pipe", "endless link", "folder"])
@pytest.mark.parametrize("name", ["pictures/x.png", "explain/x.png", "videos/x.webm"])
def test_only_plain_files_are_shown_in_a_page(here, name, kind):
    run = samples.write_run(here / "run", metrics=samples.metrics(3))
    fill(run / name, kind)
    with pytest.raises(UserError, match=re.escape(name.rpartition("/")[2])):
        report([run])


def test_a_picture_that_is_a_link_is_never_embedded(here):
    run = samples.write_run(here / "run", metrics=samples.metrics(3))
    (here / "secret").write_text("the secret")
    (run / "pictures").mkdir()
    (run / "pictures" / "x.png").symlink_to(here / "secret")
    with pytest.raises(UserError, match="is a link"):
        report([run])
    with pytest.raises(UserError, match="is a link"):
        media(run, None)


ODD = {
    "nothing": b"", "a list": b"[]", "a number": b"3",
    "deep": b'{"argv": ' + b"[" * 10_000 + b"]" * 10_000 + b"}",
    "deep objects": b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
    "a pickle": pickle.dumps(Exploit()), "not UTF-8": b'{"started": "\xff"}',
    "infinite": b'{"wall_s": 1e999}', "NaN": b'{"wall_s": NaN}',
    "half a character": b'{"started": "\\ud800"}', "many digits": b'{"wall_s": ' + b"9" * 4000 + b"}",
    "wall_s": b'{"wall_s": [1]}', "argv": b'{"argv": 3}', "argv of lists": b'{"argv": [[1], {"a": 2}, null]}',
    "hardware": b'{"hardware": 3, "versions": "none"}', "hardware as a list": b'{"hardware": ["cpu"]}',
    "seeds": b'{"seeds": 7}', "seeds null": b'{"seeds": null}', "resumed": b'{"resumed": '
                                                                           b'[3]}',
                                                                           "status": b'{"status": {"a": []}}',
    "a million lists": b'{"argv": [' + b"[]," * 2_000_000 + b"[]]}",
}  # fmt: skip


@pytest.mark.parametrize("content", ODD.values(), ids=ODD)
def test_an_odd_record_is_one_line_or_a_page(here, content):
    """A record may lack anything; what it has must be what it says it is."""
    run = samples.write_run(here / "run", metrics=samples.metrics(3))
    (run / "run.json").write_bytes(content)
    for runs, out in (([run], None), ([run, run], here / "both.html")):
        try:
            report(runs, out)
        except UserError as error:
            assert "\n" not in str(error) and len(str(error)) < 1000


def test_the_config_of_a_run_is_read_by_our_own_loader(here):
    """PyYAML's own loader takes hours over a number to the base of 60."""
    run = samples.write_run(
        here / "run", metrics=samples.metrics(3), config="train:\n  seed: 1" + ":1" * 400_000
    )
    with pytest.raises(ConfigError, match=r"config\.yaml"):
        report([run])


@pytest.mark.parametrize(
    "content",
    [pickle.dumps(Exploit()), b"[" * 200_000, b'{"use": 3}', b'{"use": {"bt": [{"share": "much"}]}}', b"[]"],
)
def test_records_of_an_evaluation_are_read_without_trust(here, content, capfd):
    (here / "eval" / "trees").mkdir(parents=True)
    (here / "eval" / "tree.json").write_bytes(content)
    assert run_cli("tree", here) == 2
    assert "tree.json" in capfd.readouterr().err


@pytest.mark.parametrize(
    "content",
    [
        b'{"use": {"bt": [{"share": 1e999, "ticks": 1, "acted": 1}]}}',
        b'{"use": {"bt": [{"share": 1, "ticks": 1e999, "acted": 1}]}}',
    ],
)
def test_numbers_of_an_evaluation_are_numbers(here, content):
    (here / "eval" / "trees").mkdir(parents=True)
    (here / "eval" / "tree.json").write_bytes(content)
    with pytest.raises(ConfigError, match="is beyond what a number holds"):
        tree_report("bt", here)


@pytest.mark.parametrize("name", ["../../secret", "/etc/passwd", "link"])
def test_a_record_cannot_name_a_tree_elsewhere(here, name):
    run, node = here / "run", {"share": 1, "ticks": 1, "acted": 1}
    (run / "eval" / "trees").mkdir(parents=True)
    (here / "secret.xml").write_text((PACKAGE / "presets/trees/straight.xml").read_text())
    (run / "eval" / "trees" / "link.xml").symlink_to(here / "secret.xml")
    (run / "eval" / "tree.json").write_text(json.dumps({"use": {name: [node]}}))
    with pytest.raises(TreeError, match=r"is a link|does not lie in"):
        tree_report(name, run)


@pytest.mark.parametrize(
    "content",
    [
        pickle.dumps(Exploit()),
        b"[" * 200_000,
        b"[]",
        b"",
        b'{"resumed": 3}',
        b'{"resumed": {"a": 1}}',
        b'{"wall_s": "long"}',
        b'{"wall_s": 1e999}',
    ],
)
def test_the_record_of_a_run_is_read_without_trust(here, content):
    (here / "run.json").write_bytes(content)
    with pytest.raises(RunFolderError, match=r"run\.json: cannot be read"):
        RunFolder.held(here).go_on({})


# ------------------------------------------------------------------------------------------ exported policies


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    root = tmp_path_factory.mktemp("export")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(deployed.deploy, "missing_packages", lambda: ["onnx"])
        deployed.exported(deployed.saved(root / "run"), root / "out")
    return root / "out"


@pytest.fixture
def folder(exported, here):
    deployed.shutil.copytree(exported, here / "out")
    return here / "out"


def objects_npz(path):
    np.savez(path, obs=np.array([Exploit()], dtype=object))


def deflated_npz(path):
    """Sixty-four megabytes of zeros in a few kilobytes."""
    np.savez_compressed(path, obs=np.zeros((1 << 24,), np.float32))


def claiming_npz(path):
    """An array that claims to have 2^50 values."""
    with zipfile.ZipFile(path, "w") as archive, archive.open("obs.npy", "w") as member:
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<f4", "fortran_order": False, "shape": (1 << 50,)}
        )


def lying_npz(path):
    """A member that claims to be stored with more bytes than there are."""
    objects = bytearray()
    np.savez(path, obs=np.zeros(4, np.float32))
    objects += path.read_bytes()
    at = objects.index(b"PK\x01\x02")
    objects[at + 20 : at + 28] = struct.pack("<II", 1 << 31, 1 << 31)
    path.write_bytes(bytes(objects))


@pytest.mark.parametrize(
    "make",
    [
        objects_npz,
        deflated_npz,
        claiming_npz,
        lying_npz,
        lambda path: path.write_bytes(pickle.dumps(Exploit())),
    ],
)
def test_golden_pairs_are_neither_pickles_nor_bombs(folder, make, capfd):
    make(folder / "golden.npz")
    deployed.resigned(folder, "golden.npz", (folder / "golden.npz").read_bytes())
    assert run_cli("export", "--check", folder) == 2
    assert "is not the golden pairs" in capfd.readouterr().err


def test_the_driver_of_a_folder_is_never_executed_by_its_check(folder):
    deployed.resigned(folder, "run_policy.py", b"open('executed', 'w')")
    assert run_cli("export", "--check", folder) == 0


def test_files_outside_an_exported_folder_are_never_opened(folder, capfd):
    spec = json.loads((folder / "policy_spec.json").read_text())
    for name in ("../../etc/passwd", "/etc/passwd", "sub/policy.onnx"):
        (folder / "policy_spec.json").write_text(
            json.dumps(spec | {"files": spec["files"] | {name: "0" * 64}})
        )
        assert run_cli("export", "--check", folder) == 2
        assert "lists other files" in capfd.readouterr().err


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
            )
    with pytest.raises(RuntimeError, match="is no ONNX graph"):
        of_onnx(pickle.dumps(Exploit()), pairs)


# ------------------------------------------------------------------------------------------------------- logs


COMMANDS = (
    ("log", "info"),
    ("log", "export", "--out", "out"),
    ("log", "repair"),
    ("log", "picture"),
    ("log", "video"),
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
    (here / "a.mcap").write_bytes((here / "a.mcap.part").read_bytes() + bomb + END)
    (here / "a.mcap.part").unlink()
    assert run_cli(*command[:2], here / "a.mcap", *command[2:]) == 2
    assert "unpack" in capfd.readouterr().err
    assert {path.name for path in here.rglob("*") if path.is_file()} == {"a.mcap"}


def test_names_of_attachments_and_topics_stay_inside(here, capfd):
    names = [
        "../../evil",
        "/tmp/evil_absolute",
        "..\\..\\evil",
        "a/../../b",
        "..",
        ".",
        "",
        "\0x",
        "C:\\evil",
        "~/.bashrc",
        "x\n--flag",
    ]
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
    "bodies at the end of the world": changed(bodies=[episode.BODIES[0] | {"position": [1e300, 0, 0]}]),
    "endless bodies": changed(bodies=[episode.BODIES[0]] * 100_000),
    "no goal": {key: value for key, value in episode.scenario().items() if key != "goal"},
    "bodies without shape": changed(bodies=[{"position": [1, 2, 3]}]),
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
        "/\x1b]52;c;ZXZpbA==\x07",
        "/[link=file:///etc/passwd]x[/link]",
        "/[/nothing]",
        "/\x9b31m\u202e",
    ):
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


def test_the_reader_of_safetensors_is_the_only_one_that_run_policy_has():
    """The drivers that go to the vehicle read with NumPy; they must not have a way to load pickles."""
    names = {
        ast.unparse(node.func)
        for module in (run_policy, run_set_policy)
        for node in ast.walk(ast.parse(Path(module.__file__).read_text()))
        if isinstance(node, ast.Call)
    }
    assert not names & {"np.load", "np.lib.format.read_array", "pickle.load", "pickle.loads"}
    assert "np.frombuffer" in names
