"""Run folders: whole files or none, and a clear word when the disk says no."""

import errno
import json
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.command import Quiet
from uuvtai.common import signals
from uuvtai.common.errors import UserError
from uuvtai.config.loader import load_config, load_resolved
from uuvtai.evaluation import evaluate
from uuvtai.logs.run_folder import RunFolder, RunFolderError, default_run_dir, refuse_place, write_atomic


def files_in(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def test_a_run_records_its_config_and_its_end(tmp_path):
    config = load_config("gauntlet")
    folder = RunFolder(tmp_path / "a" / "run", config, [1, 2])
    folder.write_json("eval/result.json", {"x": 1})
    assert json.loads((folder.path / "run.json").read_text())["status"] == "running"
    folder.finish("finished", 0)
    run = json.loads((folder.path / "run.json").read_text())
    assert (run["status"], run["exit"], run["seeds"]) == ("finished", 0, [1, 2])
    assert {"taichi", "torch", "python"} <= set(run["versions"])
    assert load_resolved(folder.path / "config.yaml") == config
    assert files_in(folder.path) == [".lock", "config.yaml", "eval/result.json", "run.json"]


@pytest.mark.parametrize("place", ["file/run", "file"])
def test_a_place_that_cannot_be_a_folder(tmp_path, place):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(RunFolderError, match="--run-dir"):
        RunFolder(tmp_path / place, load_config("pool"), [0])
    assert (tmp_path / "file").read_text() == "mine"


def test_a_full_disk_leaves_nothing_half_written(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run", load_config("pool"), [0])
    folder.write("kept.txt", "old")
    before = files_in(folder.path)

    def full(_descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RunFolderError, match="No space left on device"):
        folder.write("kept.txt", "new")
    with pytest.raises(RunFolderError, match=r"write .*other.json"):
        folder.write_json("other.json", {"x": 1})
    assert files_in(folder.path) == before
    assert (folder.path / "kept.txt").read_text() == "old"


def test_nan_never_reaches_a_json_file(tmp_path):
    folder = RunFolder(tmp_path / "run", load_config("pool"), [0])
    with pytest.raises(ValueError, match="not JSON compliant"):
        folder.write_json("bad.json", {"x": float("nan")})
    assert "bad.json" not in files_in(folder.path)


def test_write_atomic_replaces(tmp_path):
    target = tmp_path / "deep" / "file.bin"
    write_atomic(target, b"one")
    write_atomic(target, b"two")
    assert target.read_bytes() == b"two"
    assert files_in(tmp_path) == ["deep/file.bin"]


# -------------------------------------------------------------------------------------- one process at a time


def at_once(n, work):
    """What ``n`` threads get from ``work`` that all begin it together; an error counts as what it is."""
    start = threading.Barrier(n)

    def one(_i):
        start.wait()
        try:
            return work()
        except UserError as error:
            return error

    with ThreadPoolExecutor(n) as pool:
        return list(pool.map(one, range(n)))


@pytest.mark.parametrize("is_there", [False, True])
def test_of_several_that_begin_in_one_folder_exactly_one_does(tmp_path, is_there):
    config = load_config("pool")
    for i in range(10):
        place = tmp_path / str(i)
        if is_there:
            place.mkdir()
        found = at_once(8, lambda place=place: RunFolder(place, config, [0]))
        assert sum(isinstance(one, RunFolder) for one in found) == 1
        assert files_in(place) == [".lock", "config.yaml", "run.json"]


def test_of_two_processes_that_begin_in_one_folder_exactly_one_does(tmp_path):
    script = """if True:
        import sys
        from pathlib import Path
        from uuvtai.config.loader import load_config
        from uuvtai.logs.run_folder import RunFolder, RunFolderError
        config = load_config("pool")
        print("ready", flush=True)
        sys.stdin.readline()
        try:
            folder = RunFolder(Path(sys.argv[1]), config, [0])
        except RunFolderError:
            sys.exit(2)
        sys.stdin.readline()
    """
    command = [sys.executable, "-c", script, str(tmp_path / "run")]
    both = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(2)
    ]
    assert [one.stdout.readline() for one in both] == ["ready\n"] * 2
    for one in both:
        one.stdin.write("\n")
        one.stdin.flush()
    for one in both:
        one.communicate("\n")
    assert sorted(one.returncode for one in both) == [0, 2]


def test_a_run_is_held_from_its_first_file_to_its_end(tmp_path):
    folder = RunFolder(tmp_path / "run", load_config("pool"), [0])
    with pytest.raises(RunFolderError, match="another process is working in this folder"):
        RunFolder.held(folder.path)
    with pytest.raises(RunFolderError, match="already there and not empty"):
        RunFolder(folder.path, load_config("pool"), [0])
    folder.finish("finished", 0)
    again = RunFolder.held(folder.path)
    again.go_on({"from": 1})
    assert json.loads((folder.path / "run.json").read_text())["resumed"][0]["from"] == 1
    with pytest.raises(RunFolderError, match="another process"):
        RunFolder.held(folder.path)
    again.release()


def test_what_is_no_run_folder_is_left_as_it_is(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(RunFolderError, match="'uuv sweep' printed"):
        RunFolder.held(tmp_path, "uuv sweep")
    assert files_in(tmp_path) == ["mine.txt"]


def test_an_evaluation_holds_its_folder(tmp_path, monkeypatch):
    """Of 25 pairs of evaluations that began in one folder all 50 succeeded, and their files were mixed."""
    made = []
    monkeypatch.setattr(evaluate, "RunFolder", lambda *given: made.append(RunFolder(*given)) or made[0])
    monkeypatch.setattr(evaluate, "agents_of", lambda *_: [])
    monkeypatch.setattr(evaluate, "read_tree", lambda _: None)
    monkeypatch.setattr("uuvtai.sim.sim.Sim", lambda *_: SimpleNamespace(device=torch.device("cpu")))

    def scenarios(_sim, _jobs):
        with pytest.raises(RunFolderError, match="another process"):
            RunFolder.held(tmp_path / "run")
        raise LookupError("seen")

    monkeypatch.setattr("uuvtai.evaluation.evaluate.scenarios_of", scenarios)
    request = evaluate.Request(
        load_config("pool"), "pool", "paper", ["oracle"], [77], 1, run_dir=tmp_path / "run"
    )
    with pytest.raises(LookupError, match="seen"):
        evaluate.compare(request, Quiet())
    RunFolder.held(tmp_path / "run").release()


def test_default_names_do_not_collide(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = at_once(16, lambda: default_run_dir("some/world.yaml"))
    assert len(set(found)) == 16 and all(path.is_dir() and "_world" in path.name for path in found)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    refuse_place(None)
    assert not list(Path().iterdir()), "a refusal leaves nothing behind"
    Path("runs").write_text("a file")
    with pytest.raises(RunFolderError, match="Not a directory"):
        refuse_place(None)
    with pytest.raises(RunFolderError, match="--run-dir"):
        default_run_dir("pool")


# ------------------------------------------------------------------------------------------------------ links


def test_the_temporary_neighbour_is_never_somebody_elses_file(tmp_path, monkeypatch):
    monkeypatch.setattr("secrets.token_hex", lambda _n: "0")
    (tmp_path / "victim").write_text("precious")
    (tmp_path / ".x.0.tmp").symlink_to(tmp_path / "victim")
    with pytest.raises(FileExistsError):
        write_atomic(tmp_path / "x", b"new")
    assert (tmp_path / "victim").read_text() == "precious" and not (tmp_path / "x").exists()


@pytest.mark.parametrize("name", ["figures/x.png", "x.json"])
def test_nothing_is_written_through_a_link_that_came_later(tmp_path, name):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "x.png").write_text("precious")
    folder = RunFolder(tmp_path / "run", load_config("pool"), [0])
    link = folder.path / name.partition("/")[0]
    link.symlink_to(tmp_path / "outside" if "/" in name else tmp_path / "outside" / "x.png")
    with pytest.raises(RunFolderError, match="is a link"):
        folder.write(name, "new")
    assert (tmp_path / "outside" / "x.png").read_text() == "precious"


def test_what_a_kill_left_half_written_is_swept_when_the_run_goes_on(tmp_path):
    RunFolder(tmp_path / "run", load_config("pool"), [0]).finish("interrupted", 130)
    left = tmp_path / "run" / "eval" / ".result.json.0a1b2c3d.tmp"
    theirs = [
        tmp_path / "run" / name
        for name in (".notes.tmp", "result.json.0a1b2c3d.tmp", ".a.0a1b2c3.tmp", ".a.0a1b2c3d.tmp.")
    ]
    left.parent.mkdir()
    for file in (left, *theirs):
        file.write_text("{")
    RunFolder.held(tmp_path / "run").release()
    assert not left.exists() and all(file.exists() for file in theirs)


@pytest.mark.parametrize(("received", "raised", "left", "status", "code"), [
    ([], RuntimeError, RuntimeError, "failed", 1),
    ([], KeyboardInterrupt, KeyboardInterrupt, "interrupted", 130),
    ([15], RuntimeError, KeyboardInterrupt, "interrupted", 143),
], ids=["error", "interrupt", "interrupt that compiled code made an error of"])  # fmt: skip
def test_how_a_recorded_run_ends(tmp_path, monkeypatch, received, raised, left, status, code):
    monkeypatch.setattr(signals, "_received", received)
    folder = RunFolder(tmp_path / "run", load_config("pool"), [0])
    with pytest.raises(left), folder.recorded():
        raise raised
    run = json.loads((folder.path / "run.json").read_text())
    assert (run["status"], run["exit"]) == (status, code)
