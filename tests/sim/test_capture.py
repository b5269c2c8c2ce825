"""Capture and restore: a run that goes on from captured arrays never stopped, bit for bit."""

import numpy as np
import pytest
import torch

from tests.field_memory import FIELDS, copied_by_taichi
from uuvtai.common.enums import OUTCOMES
from uuvtai.envs.vector_env import VectorEnv
from uuvtai.sim.setup import copied_rows

N, SEED = 8, 11
BEFORE, AFTER = 37, 200
"""Steps before the capture (between two scans, plans and images) and after it."""

NO_NUMBER = {"f": np.nan, "i": 77, "u": 77}
"""What every array is filled with before a restore, by kind of dtype: nothing that any stage would leave."""


@pytest.fixture(scope="module")
def env(small):
    """One environment on the session's simulator."""
    small.sim.use_tree(small.trees["bt"])
    with VectorEnv(small.sim, seed=SEED) as env:
        yield env


def driven(env, first, last):
    """Everything that ``step`` returns, ``first`` to ``last``: tree or noise drives, some clocks run out."""
    out = []
    for step in range(first, last):
        noise = 2 * torch.rand(N, 4, generator=torch.Generator().manual_seed(step)) - 1
        action = torch.where(torch.arange(N)[:, None] % 2 == 0, env.sim.action, noise)
        if step % 61 == 60:
            env.sim.s.clock.step[step % N] = env.config.episode.horizon_steps - 2
        obs, reward, terminated, truncated, info = env.step(action.clone())
        out.append({"obs": obs, "reward": reward, "terminated": terminated, "truncated": truncated, **info})
        out[-1] = {name: tensor.numpy().copy() for name, tensor in out[-1].items()}
    return {name: np.stack([row[name] for row in out]) for name in out[0]}


def poison(env):
    """Overwrite every array of the simulator, scratch included, and every tensor of the environment."""
    memory = env.sim.memory()
    for view in memory.views(memory.read(), scratch=True).values():
        view[...] = NO_NUMBER[view.dtype.kind]
    env.sim.fallback.overlay[:] = np.nan
    for tensor in (env._obs, env.sim.reward, env.sim.action, *env._info.values()):
        tensor.fill_(77)


@pytest.fixture(scope="module")
def run(env):
    """(captured arrays, what the uninterrupted run showed after the capture)."""
    env.reset(seed=SEED)
    driven(env, 0, BEFORE)
    return env.capture(), driven(env, BEFORE, BEFORE + AFTER)


def test_a_restored_run_is_the_uninterrupted_one(env, run):
    """Nothing but the captured arrays is left when it goes on: everything else was overwritten."""
    arrays, wanted = run
    poison(env)
    obs, info = env.restore(arrays)
    assert torch.isfinite(obs).all() and (info["episode"] >= 0).all()
    found = driven(env, BEFORE, BEFORE + AFTER)
    for name, values in wanted.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)
    assert (wanted["terminated"] | wanted["truncated"]).sum() >= 3, "rows must end and begin anew in between"
    assert OUTCOMES.index("timeout") in wanted["outcome"]


def test_capture_changes_nothing(env, run):
    arrays, _wanted = run
    env.restore(arrays)
    again = env.capture()
    assert again.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(again[name], array, err_msg=name)
        assert array.flags.owndata and not np.shares_memory(again[name], array)


def test_views_show_every_layout_as_taichi_does(small):
    """One array of each layout that ``state.array`` knows, in both directions."""
    memory, s = small.sim.memory(), small.sim.s
    fields = {
        "route.n_queue": s.route.n_queue, "clock.step": s.clock.step, "vehicle.quat_wb": s.vehicle.quat_wb,
        "tracks.height": s.tracks.height, "scan.range_m": s.scan.range_m,
        "clearance.site": s.clearance.site, "grid_map.dynamic_occ": s.grid_map.dynamic_occ,
        "grid_map.free_scans": s.grid_map.free_scans,
    }  # fmt: skip
    views = memory.views(memory.read(), scratch=True)
    rng = np.random.default_rng(0)
    before = {name: views[name].copy() for name in fields}
    for name, field in fields.items():
        values = rng.integers(0, 99, views[name].shape).astype(views[name].dtype)
        views[name][...] = values
        np.testing.assert_array_equal(copied_by_taichi(field), values, err_msg=name)
        np.testing.assert_array_equal(field.to_numpy(), values, err_msg=f"tests see another {name}")
        field.from_numpy(np.asarray(values + 1))
        np.testing.assert_array_equal(
            copied_by_taichi(field), values + 1, err_msg=f"tests wrote another {name}"
        )
    for name, values in before.items():
        views[name][...] = values


def test_rows_are_what_a_kernel_copies(small):
    """On a GPU rows come by a kernel, on the CPU from memory: one array of each layout that is recorded."""
    s, rows = small.sim.s, [5, 0, 2]
    rng = np.random.default_rng(1)
    for field in (s.clock.step, s.vehicle.quat_wb, s.scan.range_m, s.tracks.height, s.grid_map.dynamic_occ):
        before = field.to_numpy()
        field.from_numpy(rng.integers(0, 99, before.shape).astype(before.dtype))
        found, copied = small.sim.rows(field, rows), copied_rows(field, torch.tensor(rows, dtype=torch.int32))
        assert found.dtype == copied.dtype and not np.shares_memory(found, FIELDS.view(field))
        np.testing.assert_array_equal(found, copied)
        np.testing.assert_array_equal(small.sim.rows(field)[rows], copied)
        field.from_numpy(before)


def test_put_writes_what_taichi_reads_and_refuses_what_does_not_fit(small):
    s, put = small.sim.s, small.sim.memory().put
    fields = [
        s.table.n_node, s.table.kind, s.table.param, s.mask.outside, s.mask.outside_bits,
        s.allocation.wrench_of_thrust, s.scene.n_static,
    ]  # fmt: skip
    for number, field in enumerate(fields):
        before = np.asarray(field[None]) if field.shape == () else copied_by_taichi(field)
        before = before.astype(np.int32) if field.shape == () else before
        other = (before + number + 1).astype(before.dtype)
        put(field, other)
        found = np.asarray(field[None]) if field.shape == () else copied_by_taichi(field)
        np.testing.assert_array_equal(found, other)
        with pytest.raises(ValueError, match="the field is"):
            put(field, np.zeros(other.shape, np.int8))
        put(field, before)
    with pytest.raises(ValueError, match="but got"):
        put(s.table.kind, np.zeros(1, np.int32))


def test_views_do_not_overlap(small):
    """Every byte of an array is its own, and the padding of arrays in lanes lies in the block."""
    memory = small.sim.memory()
    content = np.zeros(memory.n_bytes, np.uint8)
    total = 0
    for view in memory.views(content, scratch=True).values():
        view[...] = np.frombuffer(b"\xff" * view.itemsize, view.dtype)[0]
        total += view.nbytes
        assert np.count_nonzero(content) == total


def without(arrays, name):
    return {key: array for key, array in arrays.items() if key != name}


def edited_setting(arrays, old, new):
    return arrays | {"setting": np.frombuffer(bytes(arrays["setting"]).replace(old, new), np.uint8)}


BROKEN = {
    "missing": (lambda a: without(a, "sim.grid_map.seen"), "lacks 'grid_map.seen'.*give what capture"),
    "missing tensor": (lambda a: without(a, "env.obs"), "lacks 'obs'"),
    "unknown": (lambda a: a | {"sim.vehicle.name": np.zeros(3)},
        "holds 'vehicle.name', which this version does not know"),
    "shape": (lambda a: a | {"sim.vehicle.pos_w": np.zeros((3, 3), np.float32)},
        r"'vehicle.pos_w' is float32 \(3, 3\), but float32 \(8, 3\) is"),
    "dtype": (lambda a: a | {"env.obs": a["env.obs"].astype(np.float64)}, "'obs' is float64"),
    "no array": (lambda a: a | {"env.reward": [0.0] * N}, "'reward' is a list"),
    "other config": (lambda a: edited_setting(a, b'"horizon_steps": 3000', b'"horizon_steps": 2999'),
        "episode.horizon_steps was 2999, is 3000"),
    "other number of envs": (lambda a: edited_setting(a, b'"num_envs": 8', b'"num_envs": 9'),
        "num_envs was 9, is 8"),
    "other tree": (lambda a: edited_setting(a, b'"EmergencyTtc"', b'"Emergency"'), "tree.*EmergencyTtc"),
    "no setting": (lambda a: without(a, "setting"), "lacks 'setting'"),
    "damaged setting": (lambda a: a | {"setting": a["setting"][:40]}, "cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_what_does_not_fit_is_refused_and_changes_nothing(env, run, name):
    breaking, words = BROKEN[name]
    arrays = run[0]
    env.restore(arrays)
    env.step(torch.zeros(N, 4))
    before = env.capture()
    with pytest.raises(ValueError, match=words):
        env.restore(breaking(arrays))
    after = env.capture()
    assert all(
        np.array_equal(after[key], before[key], equal_nan=before[key].dtype.kind == "f") for key in before
    )


def test_a_capture_needs_a_reset_and_an_open_environment(small):
    fresh = VectorEnv(small.sim)
    with pytest.raises(RuntimeError, match="capture before reset"):
        fresh.capture()
    fresh.close()
    with pytest.raises(RuntimeError, match="closed"):
        fresh.capture()
    with pytest.raises(RuntimeError, match="closed"):
        fresh.restore({})
