"""What a newcomer pastes: shell lines as a page has them, and the examples as a folder of her own."""

from pathlib import Path

import pytest

from benchmarks.newcomer import _typed, shell_lines
from tests.command import uuv
from uuvtai import example_files
from uuvtai.example_files import ExampleError, copy_examples

ROOT = Path(__file__).parents[1]
PAGE = """# Page
```sh
uuv eval --controller bt \\
  --episodes 4
# a remark
python -m docs.writers.sonar_trials
```
```text
uuv: not a line
```
```sh
pip install 'uuvtai[ros]'
```
"""


def test_lines_are_joined_and_what_needs_a_checkout_is_left_out():
    assert shell_lines(PAGE) == ["uuv eval --controller bt --episodes 4", "pip install 'uuvtai[ros]'"]


def test_the_wheel_stands_in_for_the_indexs_and_the_sealed_episodes_are_not_played(tmp_path):
    (tmp_path / "dist").mkdir()
    wheel = tmp_path / "dist" / "uuvtai-1-py3-none-any.whl"
    wheel.write_text("")
    assert _typed(tmp_path, "pip install uuvtai") == f"pip install '{wheel}'"
    assert _typed(tmp_path, "pip install 'uuvtai[ros,sb3]'") == f"pip install '{wheel}[ros,sb3]'"
    assert _typed(tmp_path, "uuv benchmark all --controller mine.py:act").endswith("mine.py:act --quick")
    assert _typed(tmp_path, "uuv eval") == "uuv eval"


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
    monkeypatch.setattr(example_files, "_CHECKOUT", tmp_path)
    monkeypatch.setattr(example_files.metadata, "files", lambda name: None)
    with pytest.raises(ExampleError, match="source distribution"):
        copy_examples(tmp_path / "new")
