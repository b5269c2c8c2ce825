"""Checkpoints: the same state to the last bit, whatever kills the writer; all else is clearly refused."""

import json
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import torch
import zstandard
from safetensors.torch import save as safetensors_bytes

from uuvtai.common.files import FileError
from uuvtai.config.loader import load_training
from uuvtai.envs.vector_env import ObservationColumn
from uuvtai.learning import checkpoint
from uuvtai.learning.checkpoint import CheckpointError

TABLE = (
    ObservationColumn("goal", slice(0, 3), "m", "body", ""),
    ObservationColumn("yaw", slice(3, 4), "rad", "world", ""),
)
CONFIG = load_training("smoke", ["train.keep_checkpoints=2"])


def state_of(step):
    """A trainer's state in small: every kind of value that training keeps."""
    rng = torch.Generator().manual_seed(step)
    weight = torch.randn(5, 4, generator=rng)
    moments = {"step": torch.tensor(3.0), "exp_avg": torch.randn(4, generator=rng)}
    row = np.arange(6, dtype=np.int32).reshape(2, 3) + step
    return {
        "policy": {
            "actor.0.weight": weight,
            "actor.0.shared": weight,
            "log_std": torch.tensor(0.5, dtype=torch.float64),
        },
        "world_model": None,
        "ppo": {"state": {0: moments}, "betas": (0.9, 0.999), "lr": 0.1 + 0.2},
        "generator": rng.get_state(),
        "counters": {"iteration": step, "best": float("-inf"), "names": ["a", "b"], "done": True},
        "env": {
            "step": row,
            "map": torch.rand(2, 300, generator=rng),
            "empty": torch.zeros(0, 2),
            "number": np.array(7),
        },
    }


def assert_same(a, b):
    """Equal in type, shape and every bit."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype
        assert torch.equal(a, b)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    else:
        assert a == b


def saved(tmp_path, step=7, **more):
    return checkpoint.save(tmp_path / "checkpoints", step, state_of(step), CONFIG, TABLE, **more)


def rewritten(path, change):
    """Change a manifest as somebody would who wants it to pass: it is valid JSON."""
    document = json.loads((path / "manifest.json").read_text())
    change(document)
    (path / "manifest.json").write_text(json.dumps(document))


def test_state_comes_back_to_the_last_bit(tmp_path):
    path = saved(tmp_path, metrics={"reward": 1.5, "bad": float("nan")}, score=0.5)
    found = checkpoint.open_checkpoint(path)
    expected = state_of(7)
    expected.pop("world_model")  # a part that is off is left out
    assert (found.step, found.manifest.score, found.manifest.metrics) == (
        7,
        0.5,
        {"reward": 1.5, "bad": None},
    )
    assert found.config == CONFIG
    state = found.state(like=state_of(0))
    assert_same({name: state[name] for name in expected}, expected)
    assert sorted(p.name for p in path.iterdir()) == [
        "manifest.json", "model.safetensors", "simulator.zst", "training.safetensors",
    ]  # fmt: skip


def test_what_cannot_be_kept_is_named(tmp_path):
    with pytest.raises(CheckpointError, match=r"counters.thing: a object cannot be kept"):
        checkpoint.save(tmp_path, 1, state_of(1) | {"counters": {"thing": object()}}, CONFIG, TABLE)


def test_newest_few_and_the_best_are_kept(tmp_path):
    for step, score in ((1, 0.4), (2, 0.9), (3, None), (4, 0.9), (5, 0.1), (6, None), (7, None)):
        saved(tmp_path, step, score=score)
    names = sorted(p.name for p in (tmp_path / "checkpoints").iterdir())
    assert names == ["step_000004", "step_000006", "step_000007"], "newest two, and the newest of the best"
    assert checkpoint.best(tmp_path).step == 4
    assert checkpoint.newest(tmp_path, resumable=True).step == 7
    assert not checkpoint.best(tmp_path).is_resumable
    with pytest.raises(CheckpointError, match="networks only"):
        checkpoint.best(tmp_path).state(like=state_of(0))


def test_without_scores_the_best_is_the_newest(tmp_path):
    saved(tmp_path, 1)
    saved(tmp_path, 2)
    assert checkpoint.best(tmp_path).step == 2


def test_a_damaged_newest_one_is_left_out_and_told(tmp_path):
    older, damaged = saved(tmp_path, 1), saved(tmp_path, 2) / "simulator.zst"
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    told = []
    assert checkpoint.newest(tmp_path, told.append, resumable=True).step == 1 and "is damaged" in told[0]
    (older / "manifest.json").unlink()
    with pytest.raises(CheckpointError, match=r"no usable checkpoint \(.*simulator.zst: is damaged"):
        checkpoint.newest(tmp_path, resumable=True)


def test_a_run_without_checkpoints(tmp_path):
    with pytest.raises(CheckpointError, match="no usable checkpoint"):
        checkpoint.newest(tmp_path)


# --------------------------------------------------------------------------------------------------- refusals


def test_a_file_that_changes_after_verification(tmp_path):
    found = checkpoint.open_checkpoint(saved(tmp_path))
    (found.path / "model.safetensors").write_bytes(safetensors_bytes({"other": torch.zeros(1)}))
    with pytest.raises(CheckpointError, match="has changed since"):
        found.model()


def test_another_observation_or_action_table_is_refused(tmp_path):
    found = checkpoint.open_checkpoint(saved(tmp_path))
    found.check_table(TABLE, CONFIG)
    with pytest.raises(CheckpointError, match=r"another observation table: it expects .*'goal'.*'rad'"):
        found.check_table(TABLE[1:] + TABLE[:1], CONFIG)
    with pytest.raises(CheckpointError, match="it expects 2 rows, this environment gives 1"):
        found.check_table(TABLE[:1], CONFIG)
    with pytest.raises(CheckpointError, match=r"another action table: .*0.6.*1.5"):
        found.check_table(TABLE, load_training("smoke", ["vehicle.max_surge_m_s=1.5"]))


def test_a_config_key_that_is_younger_than_a_checkpoint_has_its_default(tmp_path):
    """A new key must not make every policy that was ever trained unreadable."""
    path = saved(tmp_path)

    def older(document):
        del document["config"]["train"]["patience"]
        document["config_sha256"] = checkpoint.config_sha256(document["config"])

    rewritten(path, older)
    assert checkpoint.open_checkpoint(path).config == CONFIG
    rewritten(path, lambda document: document["config"]["train"].update(seed=1))
    with pytest.raises(CheckpointError, match="does not have the sha256"):
        checkpoint.open_checkpoint(path)


def test_a_simulator_of_another_size_is_refused(tmp_path):
    found = checkpoint.open_checkpoint(saved(tmp_path))
    other = state_of(0)
    other["env"]["map"] = torch.zeros(3, 300)
    with pytest.raises(CheckpointError, match="other arrays than this simulator"):
        found.state(like=other)


@pytest.mark.parametrize(("size", "says"), [(599, "ends within"), (601, "more than its layout says")])
def test_a_stream_unfolds_to_what_is_expected_and_no_more(tmp_path, size, says):
    checkpoint.write_stream(tmp_path / "simulator.zst", {"x": torch.zeros(size, dtype=torch.uint8)})
    with pytest.raises(FileError, match=says):
        checkpoint.read_stream(tmp_path / "simulator.zst", {"x": torch.zeros(600, dtype=torch.uint8)})


def test_a_bomb_stays_small(tmp_path):
    """A terabyte of zeros in a few kilobytes cannot be expanded: the reader stops at the size it knows."""
    path = tmp_path / "simulator.zst"
    with path.open("wb") as file, zstandard.ZstdCompressor().stream_writer(file) as stream:
        for _ in range(64):
            stream.write(bytes(1 << 20))
    assert path.stat().st_size < 1 << 14
    with pytest.raises(FileError, match="more than"):
        checkpoint.read_stream(path, {"x": torch.zeros(1000, dtype=torch.uint8)})


# ---------------------------------------------------------------------------------------------------- SIGKILL

KILLED = """
    import os, shutil, signal, sys
    from pathlib import Path
    import torch
    torch.set_num_threads(1)
    sys.path.insert(0, {root!r})
    from tests.learning.test_checkpoint import CONFIG, TABLE, state_of
    from uuvtai.learning import checkpoint

    def killed_at(run, count):
        left = [count]
        def audit(event, _arguments):
            if event in ("open", "os.rename", "os.remove", "os.rmdir", "os.mkdir"):
                left[0] -= 1
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
        sys.addaudithook(audit)
        for step in (4, 5):
            checkpoint.save(run / "checkpoints", step, state_of(step), CONFIG, TABLE, score=1.0 / step)

    os.fsync = lambda _descriptor: None  # matters when the machine dies, not when the process does
    base = Path({folder!r})
    for step in (1, 2, 3):
        checkpoint.save(base / "0" / "checkpoints", step, state_of(step), CONFIG, TABLE, score=1.0 / step)
    for count in range(1, 400, 3):
        run = base / str(count)
        shutil.copytree(base / "0", run)
        child = os.fork()
        if child == 0:
            killed_at(run, count)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        if not os.WIFSIGNALED(status):
            print("survived", count)
            break
"""


def test_sigkill_at_any_file_operation_leaves_the_newest_verified_checkpoint_usable(tmp_path, monkeypatch):
    """Killed at its 1st, 4th, 7th, ... operation while two more are written over three older ones."""
    from tests.repository.test_architecture import ROOT

    monkeypatch.setattr("os.fsync", lambda _descriptor: None)
    script = textwrap.dedent(KILLED.format(root=str(ROOT), folder=str(tmp_path)))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    kills = range(1, int(done.stdout.split()[1]), 3)
    assert len(kills) > 15, "the writing of two checkpoints takes more file operations than that"
    steps = []
    for count in kills:
        run = tmp_path / str(count)
        found = checkpoint.newest(run, resumable=True)
        steps.append(found.step)
        state, expected = found.state(like=state_of(0)), state_of(found.step)
        assert_same(
            {name: state[name] for name in ("policy", "ppo", "env")},
            {name: expected[name] for name in ("policy", "ppo", "env")},
        )
        assert checkpoint.best(run).step == 1
        saved(run, 6)
        assert not list((run / "checkpoints").glob(".*")), "the next writer clears what was left"
        assert checkpoint.newest(run).step == 6
    assert sorted(set(steps)) == [3, 4, 5]
    assert steps == sorted(steps), "the later the kill, the newer the checkpoint"
