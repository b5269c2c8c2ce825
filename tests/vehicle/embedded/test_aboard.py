"""``uuv export LOG``: a folder that decides the same where neither Taichi nor torch can be imported."""

import json
import platform
import shutil
import struct
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("ziglang")
if sys.platform != "linux":
    pytest.skip("own machine code is for Linux so far", allow_module_level=True)

from benchmarks.aboard import _EMPTY
from tests.command import uuv
from tests.vehicle.test_replay import recorded
from uuvtai.vehicle.embedded import export, runtime
from uuvtai.vehicle.onboard import DepthShot, DvlReading, ImuReading, Mission, PressureReading, SonarPing

STEPS = 30
MACHINES = {"x86_64.so": 62, "aarch64.so": 183}
"""e_machine of ELF"""


@pytest.fixture(scope="module")
def log(small, tmp_path_factory):
    """Of a stack that tracks without a camera: three kernels less to compile."""
    off = {name: {"use_camera": False} for name in ("camera_tracking", "height")}
    sections = {name: getattr(small.config, name).model_copy(update=off[name]) for name in off}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(small.sim, "config", small.config.model_copy(update=sections))
        return recorded(small, tmp_path_factory.mktemp("aboard"), steps=STEPS)


@pytest.fixture(scope="module")
def folder(log):
    """In a process of its own: Taichi gives a kernel's text only where it is first compiled."""
    out = log.parent / "stack"
    words = [sys.executable, "-m", "uuvtai", "export", str(log), "--out", str(out), "--json"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["machines"] == ["x86_64", "aarch64"] and document["checked_steps"] == STEPS + 1
    assert document["kernels"] > 20
    return out


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy")


def alone(folder):
    """The folder's own check where what it must not need cannot be imported."""
    words = [sys.executable, "-I", "-c", _EMPTY, str(folder)]
    return subprocess.run(words, capture_output=True, text=True, check=False, cwd=folder)


def test_it_decides_the_same_without_taichi_and_torch(folder):
    done = alone(folder)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["agrees"] and found["steps"] == STEPS + 1 and found["largest_difference"] <= runtime.AGREES
    assert found["foreign"] == [] and found["memory_mib"] > 0
    with np.load(folder / "golden.npz") as golden:
        assert np.ptp(golden["commands"], axis=0).max() > 0.1  # there is something to agree on


@pytest.mark.parametrize("name", MACHINES)
def test_code_is_for_the_machine_that_it_is_named_after(folder, name):
    head = (folder / name).read_bytes()[:20]
    assert head[:4] == b"\x7fELF" and struct.unpack_from("<H", head, 18)[0] == MACHINES[name]


def test_another_decision_is_told(copy):
    with np.load(copy / "golden.npz") as golden:
        arrays = dict(golden)
    arrays["commands"][5, 0] += 0.01
    np.savez_compressed(copy / "golden.npz", **arrays)
    done = alone(copy)
    assert done.returncode == 3 and json.loads(done.stdout)["first_beyond"] == 5


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda spec: spec.update(schema=7), "has the form 7"),
        (lambda spec: spec.update(libraries={"riscv64": "x.so"}), "has no code for"),
        (
            lambda spec: spec["libraries"].update(dict.fromkeys(spec["libraries"], "none.so")),
            "cannot be loaded",
        ),
        (lambda spec: spec.clear(), "is no exported stack"),
    ],
)
def test_a_folder_that_does_not_fit_says_why(copy, change, said):
    spec = json.loads((copy / "stack.json").read_text())
    change(spec)
    (copy / "stack.json").write_text(json.dumps(spec))
    with pytest.raises(runtime.StackFolderError, match=said):
        runtime.CarriedStack(copy)


def test_a_folder_that_does_not_fit_is_one_line_and_no_traceback(copy):
    (copy / "stack.json").write_text("{}")
    done = alone(copy)
    assert done.returncode == 2 and "is no exported stack" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize("name", [f"{platform.machine()}.so", "memory.npz"])
def test_a_file_that_has_changed_is_not_loaded(copy, name):
    with (copy / name).open("ab") as file:
        file.write(b"\0")
    with pytest.raises(runtime.StackFolderError, match=f"{name} has changed since"):
        runtime.CarriedStack(copy)


def test_begun_anew_it_decides_the_same_again(folder):
    """The whole memory of a mission is forgotten; another start gives another decision."""
    first, second = runtime.compare(folder), runtime.compare(folder)
    assert first["agrees"] and second["largest_difference"] == first["largest_difference"]
    pilot = runtime.carried_pilot(folder, Mission((2.0, 3.0, -0.8), (18.0, 3.0, -0.8)))
    command = pilot.tick()
    assert command.held and not command.action.any()
    assert command.pos_w[0] == 2.0


def test_a_route_that_cannot_be_planned_leaves_the_old_one(folder):
    pilot = runtime.carried_pilot(folder)
    pilot.tick()
    running = pilot.stack
    assert isinstance(running, runtime.CarriedStack) and len(running._keep) == 1
    running.views["route.n_failed"][...] = 1
    before = running.views["route.n_way"].copy()
    for line in running._keep:
        line()
    np.testing.assert_array_equal(running.views["route.n_way"], before)


def test_messages_are_packed_whole():
    told = [
        (0, ImuReading(0.0, np.array([0.1, 0.2, 0.3]), np.zeros(3), np.array([0.0, 0.0, 9.81]))),
        (0, SonarPing(0.0, np.array([1.0, 2.0]), np.array([1, 0]), np.zeros(0), 7)),
        (2, SonarPing(0.02, np.array([3.0]), np.array([1]), np.array([0.5]), 9)),
        (3, PressureReading(0.06, 0.8)),
        (4, DepthShot(0.08, np.arange(6.0).reshape(2, 3))),
        (4, DvlReading(0.08, np.array([0.1, 0.0, 0.0]))),
    ]
    again = runtime.messages_in(runtime.packed_messages(told), (2, 3))
    assert [step for step, _ in again] == [step for step, _ in told]
    for (_, one), (_, other) in zip(told, again, strict=True):
        assert type(one) is type(other)
        for name in vars(one):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_what_cannot_be_written_is_refused_before_the_work(log, tmp_path, capfd, monkeypatch):
    code, _, err = uuv(capfd, "export", log, "--out", tmp_path / "new", "--for", "riscv64")
    assert code == 2 and "must be of x86_64, aarch64" in err
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a").touch()
    code, _, err = uuv(capfd, "export", log, "--out", tmp_path / "full")
    assert code == 2 and "is there already" in err
    code, _, err = uuv(capfd, "export", tmp_path / "none.mcap", "--out", tmp_path / "new")
    assert code == 2 and "none.mcap" in err
    code, _, err = uuv(capfd, "export", "--out", tmp_path / "new")
    assert code == 2 and "RUN" in err
    monkeypatch.setattr(export.importlib.util, "find_spec", lambda name: None)
    code, _, err = uuv(capfd, "export", log, "--out", tmp_path / "new")
    assert code == 2 and "uuvtai[aboard]" in err
    assert not (tmp_path / "new").exists()
