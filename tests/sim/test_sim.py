"""The whole step: determinism, independence of envs, zero copy."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.conftest import estimate_pose, launch_one_by_one
from tests.small_sim import SmallSim
from uuvtai.common.errors import DivergenceError
from uuvtai.compile.runtime import start_taichi
from uuvtai.config.loader import load_config
from uuvtai.evaluation.episodes import jobs_of, run_episodes
from uuvtai.sim.setup import check_size, memory_bytes
from uuvtai.sim.sim import Sim

ROOT = Path(__file__).resolve().parents[2]

SENSED = (
    "ego", "scan", "image", "tracks", "turn_history", "forecast", "grid_map", "clearance", "route",
    "observation", "behavior",
)  # fmt: skip
"""Structs of what the vehicle senses, remembers and decides (clusters are scratch of one scan: slots beyond
their count are stale)."""


LISTS = ("route.queue", "route.failed")
"""Lists of env ids, not rows of envs."""


def equal(a, b, rows_a, rows_b):
    """Names of the arrays whose rows differ in any bit."""
    rows = [name for name in a if a[name].ndim and a[name].shape[0] == 8 and name not in LISTS]
    return [
        name
        for name in rows
        if not np.array_equal(a[name][rows_a], b[name][rows_b], equal_nan=a[name].dtype.kind == "f")
    ]


@pytest.mark.parametrize("estimated", [False, True])
def test_an_episode_is_the_same_in_any_row_and_company(small, monkeypatch, estimated):
    """Where the vehicle is told its place nothing writes the pose filter's memory."""
    if estimated:
        estimate_pose(monkeypatch, small)
    looked_at = (*SENSED, "vehicle", "world", "termination", *["localization"] * estimated)
    small.begin([0, 1, 2, 3])
    for _ in range(120):
        small.sim.step()
    first = small.arrays(*looked_at)
    small.begin([5, 3, 6, 7, 1, 2, 0], rows=[0, 1, 2, 3, 4, 5, 6])
    for _ in range(120):
        small.sim.step()
    again = small.arrays(*looked_at)
    assert ("localization.mean" in first) == estimated
    assert equal(first, again, [0, 1, 2, 3], [6, 4, 5, 1]) == []
    assert equal(first, again, [0], [0]) != [], "another episode must differ"


@pytest.mark.parametrize("estimated", [False, True])
def test_a_reset_touches_only_its_rows(small, monkeypatch, estimated):
    if estimated:
        estimate_pose(monkeypatch, small)
    looked_at = (*SENSED, "vehicle", "world", "termination", "episode", *["localization"] * estimated)
    small.begin(list(range(8)))
    for _ in range(40):
        small.sim.step()
    before = small.arrays(*looked_at)
    small.begin([40, 41], rows=[2, 5])
    after = small.arrays(*looked_at)
    rest = [0, 1, 3, 4, 6, 7]
    assert equal(before, after, rest, rest) == []
    assert equal(before, after, [2], [2]) != []


def test_the_camera_is_asked_about_heights_only_if_the_config_says_so(small, monkeypatch):
    """The kernels that read this section are left out: nothing is compiled for the switch."""
    asked, sim = [], small.sim
    launch_one_by_one(monkeypatch, sim)
    small.begin([0])
    monkeypatch.setattr("uuvtai.sim.stack.tracking.track_obstacles", lambda *_: None)
    monkeypatch.setattr("uuvtai.sim.stack.height.bound_heights", lambda *_: None)
    monkeypatch.setattr("uuvtai.sim.stack.camera_tracking.look_at_obstacles", lambda *_: asked.append(1))
    for use, calls in ((True, 3), (False, 0)):
        changed = small.config.height.model_copy(update={"use_camera": use})
        monkeypatch.setattr(sim, "config", small.config.model_copy(update={"height": changed}))
        for _ in range(3):
            sim.step()
        assert len(asked) == calls
        asked.clear()


def test_tensors_are_shared_not_copied(small):
    sim = small.sim
    pointers = [t.data_ptr() for t in (sim.action, sim.reward, sim.terminated, sim.truncated)]
    small.begin(list(range(8)))
    before = sim.reward.clone()
    sim.step(torch.full((8, 4), 0.25))
    assert [t.data_ptr() for t in (sim.action, sim.reward, sim.terminated, sim.truncated)] == pointers
    assert not torch.equal(before, sim.reward), "the kernel writes torch's own memory"


def test_outcomes_do_not_depend_on_order_or_batch(small):
    """Ten episodes through eight rows, both ways round: the same list of results."""
    sim = small.sim
    sim.use_tree(small.trees["straight"])
    jobs = jobs_of([7], 10)

    def told(results):
        return [(r.episode, r.outcome, r.time_s, r.min_clearance_m) for r in results]

    alone = [found for job in jobs for found in told(run_episodes(sim, [job])[0])]
    for way in (1, -1):
        results, steps = run_episodes(sim, jobs[::way])
        assert told(results)[::way] == alone
        assert steps == sum(round(r.time_s / small.config.episode.control_dt_s) for r in results)
    sim.use_tree(small.trees["bt"])


def test_scene_is_data(small):
    """S, D and v change without another simulator, and what does not fit is refused."""
    sim = small.sim
    sim.set_scenes([(3, 9, 1.5)])
    small.begin([0])
    kinds = sim.s.world.kind.to_numpy()[0]
    slots = len(kinds) - 9
    assert (kinds[:slots] != 0).sum() == 3
    assert (kinds[slots:] != 0).sum() == 9
    moving = np.linalg.norm(sim.s.world.vel_w.to_numpy()[0, slots:], axis=1)
    np.testing.assert_allclose(moving, 1.5, rtol=1e-4)
    sim.set_scenes([(8, 6, 0.6), (2, 0, 0.6), (5, 7, 0.3)])
    small.begin([0, 1, 2, 3])
    obstacles = sim.s.world.kind.to_numpy()[:4] != 0
    assert obstacles[:, :slots].sum(axis=1).tolist() == [8, 2, 5, 8], "dealt out in turn"
    assert obstacles[:, slots:].sum(axis=1).tolist() == [6, 0, 7, 6]
    with pytest.raises(ValueError, match="dynamic_capacity"):
        sim.set_scenes([(3, 10, 1.5)])
    sim.set_scenes()


def test_another_kind_of_runtime_in_one_process_is_refused():
    with pytest.raises(RuntimeError, match="already runs"):
        start_taichi("cpu", precision="f64")
    with pytest.raises(ValueError, match="unknown device"):
        start_taichi("tpu")


def test_absurd_sizes_are_refused_before_anything_is_allocated():
    config = load_config("pool")
    with pytest.raises(ValueError, match="at least 1 env"):
        check_size(config, 0, "cpu")
    with pytest.raises(MemoryError, match=r"GiB.*use --num-envs \d+ or fewer"):
        check_size(config, 900_000, "cpu")
    with pytest.raises(MemoryError, match="not supported"):
        check_size(config, 10**9, "cpu")
    assert memory_bytes(config, 400) < 2.1 * memory_bytes(config, 200)


def test_a_closed_simulator_leaves_its_arrays_to_the_next_one_as_new(small):
    """Whatever was done in it: no other tree of fields is made, and no byte differs."""
    first = Sim(small.config, small.N, small.trees["bt"])
    new, address = first.memory().read().copy(), first.memory().address
    first.reset(*(torch.ones(small.N, dtype=torch.int32) for _ in range(3)))
    first.step()
    assert first.memory().read().tobytes() != new.tobytes()
    first.close()
    with pytest.raises(AttributeError):
        first.step()
    second = Sim(small.config, small.N, small.trees["bt"])
    assert second.memory().address == address and second.memory().read().tobytes() == new.tobytes()
    other = Sim(small.config, small.N, small.trees["bt"])
    assert other.memory().address != address, "one that is open keeps its own"
    other.close()
    second.close()


@pytest.mark.skipif(not Path("/sys/kernel/mm/transparent_hugepage").exists(), reason="no huge pages here")
def test_arrays_lie_in_huge_pages_where_the_system_has_them(small):
    address, holds, flags = small.sim.memory().address, False, []
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if found := re.match(r"([0-9a-f]+)-([0-9a-f]+) ", line):
            holds = int(found[1], 16) <= address < int(found[2], 16)
        if holds and line.startswith("VmFlags:"):
            flags = line.split()
    assert "hg" in flags


def test_memory_of_closed_environments_is_given_back():
    """In a process of its own, whose memory is no other test's; and which has many fields besides."""
    code = (
        "import taichi as ti, benchmarks.robustness as r, uuvtai.compile.runtime as c; c.start_taichi('cpu');"
        "others = [ti.field(ti.i32, shape=1) for _ in range(80)];"
        f"print(r.memory_growth_mib({SmallSim.N}, 2, overrides={SmallSim.CHANGES}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert float(done.stdout.split()[-1]) < 8.0, "MiB; 2 that are kept take 40"


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_vehicle_that_diverges_is_an_error_of_the_user(small, value):
    small.begin([3, 4])
    small.sim.memory().live(small.sim.s.vehicle.vel_b)[1, 2] = value
    with pytest.raises(DivergenceError, match=r"1 of 8 vehicles diverged, first that of env 1.*substeps"):
        small.sim.step()
