"""Run folders: whole files or none, and a clear word when the disk says no."""

import errno
import json
import os

import pytest

from uuvtai.loader import load_config, load_resolved
from uuvtai.run_folder import RunFolder, RunFolderError, write_atomic


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
