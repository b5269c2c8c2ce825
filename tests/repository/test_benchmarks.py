"""Benchmarks: what rows say, each is found and described, kernels and peers agree where that is cheap."""

import ast
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import before, dynamics, parity, run, tick
from benchmarks.common import Job, Row, seconds_per_call
from benchmarks.digest import digest
from benchmarks.peers.vehicle_arrays import Vehicles
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config
from uuvtai.sim.plant import Plant

FOLDER = Path(run.__file__).parent
NAMES = sorted(path.stem for path in FOLDER.glob("*.py") if path.stem not in run.NOT_BENCHMARKS)
TINY = Job(quick=True, seconds=0.02)


def test_ratio_and_floor_know_which_way_is_better():
    rate = Row("", 30.0, "1/s", peer=10.0, floor=2.5, floor_on="ratio")
    assert rate.ratio == 3.0 and rate.met
    assert Row("", 2.0, "ms", peer=10.0, less_is_better=True).ratio == 5.0
    assert Row("", 2.0, "ms", less_is_better=True, floor=3.0).met
    assert not Row("", 4.0, "ms", less_is_better=True, floor=3.0).met
    assert not Row("", 2.0, "1/s", floor=3.0).met
    assert Row("", 2.0, "ms", peer=10.0, less_is_better=True, floor=6.0, floor_on="ratio").met is False
    assert Row("", None, "ms", floor=3.0).met is False and Row("", 1.0, "ms").met is None


def test_stopwatch_takes_turns_and_gives_the_median():
    now, order = [0.0], []

    def call(name, took):
        def work():
            order.append(name)
            now[0] += took.pop(0)

        return work

    sides = {
        "slow": call("slow", [9.0, 3.0, 3.0, 50.0, 2.0]),
        "fast": call("fast", [9.0, 1.0, 1.0, 1.0, 0.5]),
    }
    assert seconds_per_call(sides, 3.0, lambda: now[0], rounds=3) == {"slow": 3.0, "fast": 1.0}
    assert order == ["slow", "slow", "fast", "fast", *["slow", "fast"] * 3]


@pytest.mark.parametrize("name", NAMES)
def test_every_benchmark_measures_and_says_what(name):
    module = ast.parse((FOLDER / f"{name}.py").read_text())
    measure = [node for node in module.body if isinstance(node, ast.FunctionDef) and node.name == "measure"]
    assert [argument.arg for argument in measure[0].args.args] == ["job"]
    assert len((ast.get_docstring(module) or "").split("\n\n")[0]) > 40
    devices, threads, longest_s = run._traits(name)
    assert set(devices) <= {"cpu", "cuda"} and threads in (None, 1)
    assert longest_s >= 1200
    assert f"`{name}`" in (FOLDER / "README.md").read_text()


def test_rows_have_figures_beside_peers():
    """measure raises where the kernel and its peers disagree."""
    for row in tick.measure(TINY):
        assert row.ours > 0 and row.peer > 0 and math.isfinite(row.ratio)
        assert row.what and row.unit and row.peer_name
        assert row.document()["ratio"] == row.ratio


def test_peers_of_dynamics_agree_and_a_wrong_one_is_seen():
    """The check before the clock starts sees drag that is off by a thousandth."""
    config, n_env = Config(), 16
    plant = Plant(config, start_taichi("cpu"), n_env)
    actions = np.random.default_rng(1).uniform(-1, 1, (n_env, 4)).astype(np.float32)
    columns = np.ascontiguousarray(actions.T)

    def apart(xp, factor):
        plant.reset()
        peer = Vehicles(config, n_env, xp)
        peer.quadratic *= factor
        turned = {"peer": columns if xp is np else torch.from_numpy(columns)}
        steps = {"peer": dynamics._step_of_peer(peer, "peer", "cpu")}
        return dynamics.disagreement(plant, {"peer": peer}, steps, actions, turned)

    for exact in (apart(np, 1.0), apart(torch, 1.0)):
        assert exact.shape == (n_env,) and np.all(exact < dynamics.AGREEMENT)
    assert np.mean(apart(torch, 1.001) > dynamics.AGREEMENT) > 0.5, "drag that is off shows in most vehicles"
    assert np.abs(plant.vehicle.vel_b.to_numpy()).max() > 0.2, "nothing moved"


def test_a_digest_is_of_the_code_that_is_timed(tmp_path):
    """Imported or run, without its comments."""
    files = {"a": "from uuvtai import low\n", "b": "import subprocess\n"}
    files = {f"benchmarks/{name}.py": text for name, text in files.items()}
    files |= {"uuvtai/low.py": "def f():\n    return 1\n", "uuvtai/other.py": "A = 1\n"}

    def digests(name, **changed):
        place = tmp_path / name
        for file, text in (files | {f"uuvtai/{module}.py": text for module, text in changed.items()}).items():
            (place / file).parent.mkdir(parents=True, exist_ok=True)
            (place / file).write_text(text)
        return digest("a", place), digest("b", place)

    first = digests("first")
    said = '"""Module."""\n\n\ndef f():  # why\n    """Function."""\n    return 1\n'
    assert digests("said", low=said) == first
    imported, run_as_a_command = digests("other", other="A = 2\n")
    assert imported == first[0] and run_as_a_command != first[1]
    assert digests("body", low=files["uuvtai/low.py"].replace("1", "2"))[0] != first[0]


def test_unknown_names_are_refused():
    done = subprocess.run(
        [sys.executable, str(FOLDER / "run.py"), "sonra"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2 and "sonra" in done.stderr and "tick" in done.stderr


def test_what_differs_from_a_commit_is_counted_and_what_one_side_lacks_is_named():
    same = before.equal("arrays", {"a": "1"}, {"a": "1"}, "abc")
    assert (same.ours, same.met) == (0, True)
    row = before.equal("arrays", {"a": "1", "b": "2", "new": "3"}, {"a": "1", "b": "x", "gone": "4"}, "abc")
    assert (row.ours, row.met, row.details["differ"]) == (1, False, ["b"])
    assert row.note == "of 2: b; only here, 1: new; only abc, 1: gone"
    assert before.equal("arrays", {"new": "3"}, {"gone": "4"}, "abc").met is False, "nothing was compared"
    found = before.equal("arrays", {"a": "1", "new": "3", "twice": "3"}, {"a": "1", "old": "3"}, "abc")
    assert (found.met, found.details["renamed"]) == (True, {"new": "old"})
    assert found.note == "of 2; 1 of them renamed; only here, 1: twice"


# -------------------------------------------------------------------------------------- parity


def test_parity_asks_for_a_policy():
    with pytest.raises(SystemExit, match="--policy RUN"):
        parity.measure(Job(quick=True))
