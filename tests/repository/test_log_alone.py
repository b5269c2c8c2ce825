"""Real recordings opened with the viewers' own reader, and every claim in them recomputed from the file
alone.

The recomputation is ``tests/oracles/log_alone.py``, which knows scenario.json's formulas and config.yaml
and nothing of uuvtai.
"""

import ast
import copy
import hashlib
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader

from tests.command import read_by_viewer, run_cli
from tests.oracles import decision_alone, log_alone
from tests.small_sim import SmallSim
from uuvtai.config.loader import load_config, load_resolved

HORIZON = 200
"""as in test_cli.py: the same kernels are compiled once"""

FIT_SHARE = 0.99
"""beams that pass within float32 of an edge may meet what is behind it"""
PAPER_RANGE_M, PAPER_DOPPLER_M_S = 0.02, 0.05
"""sigmas of the preset"""
SIGMAS = 5.0
"""bound of a mean and a sigma in standard errors of their estimates"""
AGREEMENT, AGREEMENT_EACH = 0.999, 0.99
"""share of touched cells over all logs and in each: a point within float32 of a cell's edge may fall in the
next cell (1 in 10^5)"""
DISTANCE_M = 1e-5
"""float32 of a distance of metres"""
SAFETY_M, TTC_SHARE = 1e-3, 1e-2
VELOCITY_M_S, COST_SHARE = 1e-5, 1e-3
"""float32 of headings and of roll-outs; a cost may differ by more where a place falls within float32 of a
cell's edge or an obstacle's height"""
CLOSED_FORM = 1e-5
"""[m] and [m/s], float32 of arcs of tens of metres"""


def recorded(folder, *options):
    """Logs, without their pictures, and the result."""
    horizon = ("--set", f"episode.horizon_steps={HORIZON}")
    with pytest.MonkeyPatch.context() as undrawn:
        undrawn.setattr("uuvtai.evaluation.evaluate._draw", lambda *_: None)
        assert run_cli("eval", *SmallSim.OPTIONS, *horizon, "--run-dir", folder, *options) == 0
    return sorted((folder / "logs").glob("*.mcap")), json.loads((folder / "eval/result.json").read_text())


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Logs of real evaluations by their preset of sensors, and the results for 'paper'."""
    folder = tmp_path_factory.mktemp("recorded")
    paper, printed = recorded(
        folder / "paper", "--agent", "straight,bt", "--seeds", "7", "--episodes", "2", "--record", "2"
    )
    once = ["--agent", "bt", "--sensors", "clean", "--seeds", "3", "--episodes", "1", "--record", "1"]
    clean, _ = recorded(folder / "clean", *once, "--set", "world.obstacle_acceleration_m_s2=0.5")
    return {"paper": paper, "clean": clean, "printed": printed}


@pytest.fixture(scope="module")
def logs(recordings):
    return {path: log_alone.Log(path) for path in [*recordings["paper"], *recordings["clean"]]}


@pytest.fixture(scope="module")
def figures(logs):
    return {path: log_alone.figures(log) for path, log in logs.items()}


@pytest.fixture(scope="module")
def short_log(logs, recordings):
    """The recording with the fewest steps under 'paper'."""
    return min((logs[path] for path in recordings["paper"]), key=lambda log: len(log.messages["/state"]))


# --------------------------------------------------------------------------------------------------- the file


def test_the_viewers_own_reader_decodes_every_message_against_its_schema(recordings):
    path = next(path for path in recordings["paper"] if path.name.startswith("straight_seed7_episode0"))
    found = read_by_viewer(path)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary and summary.statistics
    counts = {
        summary.channels[channel].topic: n
        for channel, n in summary.statistics.channel_message_counts.items()
        if n
    }
    assert found["counts"] == counts and len(counts) >= 22
    assert found["unlikeOfficial"] == []
    assert found["metadata"] == ["uuv.run", "uuv.result"]
    assert found["attachments"] == ["config.yaml", "scenario.json", "tree.xml"]


def test_what_describes_the_run_loads(recordings, logs, tmp_path):
    for path in (recordings["paper"][0], recordings["clean"][0]):
        log = logs[path]
        (tmp_path / "config.yaml").write_text(yaml.safe_dump(log.config))
        sensors = "clean" if path in recordings["clean"] else "paper"
        overrides = {**SmallSim.CHANGES, "episode.horizon_steps": HORIZON}
        overrides |= {"world.obstacle_acceleration_m_s2": 0.5} if sensors == "clean" else {}
        assert load_resolved(tmp_path / "config.yaml") == load_config("pool", sensors, overrides=overrides)
        assert log.metadata["uuv.run"]["config_sha256"] == hashlib.sha256(log.config_text).hexdigest()


def test_every_topic_comes_at_its_rate(logs):
    for log in logs.values():
        last = len(log.messages["/state"]) - 1
        control = ("/tf", "/pose", "/pose_estimate", "/state", "/action", "/policy", "/safety", "/tree")
        every_ping = ("/sonar/scan", "/sonar/doppler", "/tracks")
        assert log.config["sensors"]["sonar"]["period_steps"] == 1
        for topic in (*control, *every_ping):
            assert log.steps(topic) == list(range(last + 1)), topic
        for topic in ("/goal", "/obstacles", "/obstacles/truth"):
            assert log.steps(topic) == sorted({*range(0, last + 1, 5), last}), topic
        assert log.steps("/camera/line") == list(
            range(0, last + 1, log.config["sensors"]["depth"]["period_steps"])
        )
        replans = log.steps("/plan")
        assert len(replans) == int(log.metadata["uuv.result"]["replans"])
        assert log.steps("/plan/info") == replans
        assert log.steps("/log") == sorted([*replans, last])
        due, newest = [], -math.inf
        for step in range(last + 1):
            if step in replans or step == last or step - newest >= 25:
                due.append(step)
                newest = step
        for topic in ("/map/static", "/map/dynamic", "/map/clearance", "/map/risk"):
            assert log.steps(topic) == due, topic


# ------------------------------------------------------------------------------------- the independent script


def test_the_script_imports_only_general_libraries():
    tree = ast.parse(Path(log_alone.__file__).read_text())
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    outside = {name.partition(".")[0] for name in names} - set(sys.stdlib_module_names)
    assert outside == {"numpy", "scipy", "mcap", "yaml"}


def test_clean_scans_are_recast_from_the_true_obstacles(recordings, figures):
    for path in recordings["clean"]:
        found = figures[path]["sonar"]
        assert found["beams"] > 40_000 and found["returns_of_moving_obstacles"] > 500
        assert found["no_return_is_max_range"]
        assert found["fitting_share"] >= FIT_SHARE
        assert found["range_within_2_mm"] >= FIT_SHARE and found["range_max_m"] < 0.15
        assert found["doppler_within_1e_3"] >= FIT_SHARE


def test_noisy_scans_are_the_true_obstacles_plus_the_noise_of_the_preset(recordings, figures):
    for path in recordings["paper"]:
        found = figures[path]["sonar"]
        assert found["fitting_share"] >= FIT_SHARE
        for name, sigma in (("range", PAPER_RANGE_M), ("doppler", PAPER_DOPPLER_M_S)):
            unit = {"range": "m", "doppler": "m_s"}[name]
            standard_error = sigma / math.sqrt(found["returns"])
            assert abs(found[f"{name}_mean_{unit}"]) < SIGMAS * standard_error
            assert abs(found[f"{name}_sigma_{unit}"] - sigma) < SIGMAS * standard_error / math.sqrt(2)


def test_camera_pixels_are_recast_from_the_true_obstacles(figures):
    assert sum(found["camera"]["pixels"] for found in figures.values()) > 3_000
    for found in figures.values():
        assert found["camera"]["share_within"] >= FIT_SHARE and found["camera"]["gate_overrun_m"] < DISTANCE_M


def test_obstacles_move_in_closed_form(figures):
    for found in figures.values():
        assert max(found["obstacles"].values()) < CLOSED_FORM


@pytest.mark.parametrize("layer", ["static", "dynamic"])
def test_the_map_is_redone_from_the_scans(layer, figures):
    found = [each["map"][layer] for each in figures.values()]
    touched = [each["touched_cells"] for each in found]
    agreeing = [each["agreeing_share_of_touched"] for each in found]
    assert min(touched) > 100 and sum(each["occupied_cells"] for each in found) > 500
    assert min(agreeing) >= AGREEMENT_EACH
    assert sum(n * share for n, share in zip(touched, agreeing, strict=True)) >= AGREEMENT * sum(touched)


@pytest.mark.parametrize("spoil", [
    lambda log: log.messages.update({"/camera/line": []}),
    lambda log: log.messages.update({"/tracks": []}),
    lambda log: log.config["mapping"].update(doppler_evidence_m_s=99.0),
    lambda log: log.config["mapping"].update(free_range_m=1.0, static_free=0.0),
], ids=["without_camera", "without_tracks", "without_doppler", "without_free_water"])  # fmt: skip
def test_the_map_cannot_be_redone_without(spoil, short_log):
    """Each ingredient leaves its mark, so that agreement means something."""
    spoilt = copy.copy(short_log)
    spoilt.config, spoilt.messages = copy.deepcopy(short_log.config), copy.copy(short_log.messages)
    spoil(spoilt)
    found = log_alone.map_figures(spoilt, 1e-3)
    assert min(found[layer]["agreeing_share_of_touched"] for layer in ("static", "dynamic")) < 0.99


def test_clearance_and_risk_follow_from_the_map(figures):
    for found in (each["map"]["clearance"] for each in figures.values()):
        assert found["grids_with_their_map"] > 0 and found["max_error_m"] < DISTANCE_M
        assert found["risk_max_error"] < DISTANCE_M
        assert found["agreeing_share_from_scans"] >= AGREEMENT_EACH


def test_hull_clearance_and_time_to_collision_follow_at_every_step(figures):
    for found in (each["safety"] for each in figures.values()):
        assert found["clearance_max_error_m"] < SAFETY_M and found["min_clearance_error_m"] < SAFETY_M
        assert found["ttc_compared"] > 20 and found["ttc_max_relative_error"] < TTC_SHARE
        assert found["ttc_null_disagrees"] == 0 and found["ttc_doubtful"] <= 0.05 * found["steps"]


def test_the_outcome_follows_from_the_rules(recordings, logs, figures):
    for found in (each["safety"] for each in figures.values()):
        assert found["outcome"] == found["outcome_told"] and found["ends_at_the_last_step"]
        assert found["time_error_s"] < 1e-6
    printed = {
        (agent["name"], str(entry["seed"]), str(entry["episode"])): entry["outcome"]
        for agent in recordings["printed"]["agents"]
        for entry in agent["episodes_detail"]
    }
    for path in recordings["paper"]:
        run = logs[path].metadata["uuv.run"]
        assert figures[path]["safety"]["outcome"] == printed[run["agent"], run["seed"], run["episode"]]
    outcomes = {found["safety"]["outcome"] for found in figures.values()}
    assert outcomes == {"success", "collision", "ttc", "timeout"}


def test_the_choice_among_evasions_is_redone(logs):
    """From the logged costs: the least candidate or the mean of the best ones, by its velocity."""
    means = least = 0
    for log in logs.values():
        temperature = log.config["behavior"]["temperature"]
        for own in decision_alone.decisions(log):
            velocities, _ = decision_alone.candidates(log, own)
            assert len(velocities) == len(own.costs)
            if own.candidate < 0:
                chosen = decision_alone.mean_of_the_best(log, own, velocities)
                assert own.cost <= own.costs.min() + temperature + 1e-6
                means += 1
            else:
                assert own.candidate == own.costs.argmin() and own.cost == own.costs.min()
                chosen = velocities[int(own.candidate)]
                least += 1
            np.testing.assert_allclose(own.velocity, chosen, atol=VELOCITY_M_S)
    assert means > 10 and least > 0


def test_costs_of_evasions_are_redone_from_the_tracks_and_the_map(logs):
    """Of every candidate, and of the mean where it was chosen: equal where the clearance of the decision's
    own step is in the log, and never more elsewhere, of every eighth, where what stands still is left out."""
    equal, rest, n_track = [], [], 0
    for log in logs.values():
        for own in decision_alone.decisions(log):
            velocities, lasts = decision_alone.candidates(log, own)
            if own.candidate < 0:
                velocities, lasts = np.vstack([velocities, own.velocity]), np.append(lasts, np.inf)
                own.costs = np.append(own.costs, own.cost)
            some = slice(None, None, 8 if own.grid is None else 1)
            redone = decision_alone.costs(log, own, velocities[some], lasts[some])
            left = (own.costs[some] - redone) / np.maximum(own.costs[some], 1.0)
            (rest if own.grid is None else equal).append(left)
            n_track += len(own.tracks)
    equal, rest = np.concatenate(equal), np.concatenate(rest)
    assert len(equal) > 2 * 160 and n_track > 20
    assert np.mean(np.abs(equal) < COST_SHARE) > 0.99
    assert np.mean(rest > -COST_SHARE) > 0.99 and np.mean(np.abs(rest) < COST_SHARE) > 0.2
