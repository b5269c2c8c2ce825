"""``uuv examples``: the examples as a folder of one's own."""

import errno
from pathlib import Path

import pytest

from tests.command import uuv
from uuvtai.console import doctor
from uuvtai.console.doctor import ExampleError, copy_examples

ROOT = Path(__file__).parents[2]


def test_examples_are_copied_whole_and_nothing_is_overwritten(capfd, tmp_path):
    code, out, _ = uuv(capfd, "examples", str(tmp_path / "mine"))
    copied = {Path(line).name: Path(line).read_bytes() for line in out.split()}
    assert code == 0 and copied["own_astar.py"] == (ROOT / "examples" / "own_astar.py").read_bytes()
    assert set(copied) == {path.name for path in (ROOT / "examples").iterdir() if path.is_file()}
    (tmp_path / "mine" / "judge.py").write_text("hers")
    (tmp_path / "mine" / "custom_controller.py").unlink()
    with pytest.raises(ExampleError, match="uuv examples NEW"):
        copy_examples(tmp_path / "mine")
    assert (tmp_path / "mine" / "judge.py").read_text() == "hers"
    assert not (tmp_path / "mine" / "custom_controller.py").exists(), "all or nothing"


def test_a_place_that_cannot_be_written_and_a_package_without_examples_are_told(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ExampleError, match="cannot write there"):
        copy_examples(tmp_path / "file" / "in")
    with monkeypatch.context() as full, pytest.raises(ExampleError, match="No space left"):
        written = iter(range(5))
        full.setattr("os.fsync", lambda _file: _full_disk() if next(written, None) is None else None)
        copy_examples(tmp_path / "new")
    assert not list((tmp_path / "new").iterdir())
    monkeypatch.setattr(doctor, "_CHECKOUT", tmp_path)
    monkeypatch.setattr(doctor.metadata, "files", lambda name: None)
    with pytest.raises(ExampleError, match="source distribution"):
        copy_examples(tmp_path / "new")


def _full_disk():
    raise OSError(errno.ENOSPC, "No space left on device")
