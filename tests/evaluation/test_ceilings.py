"""Ceilings in ``uuv eval``: privileged rows in document and on screen, on paired episodes."""

import json

import pytest

from tests.command import uuv
from tests.small_sim import SmallSim
from uuvtai.evaluation.agents import load_agents
from uuvtai.evaluation.episodes import Job
from uuvtai.evaluation.evaluate import remainder_of, scenarios_of

SEED = 3


@pytest.fixture
def borrowed(small, monkeypatch):
    """``uuv eval`` plays on the session's small simulator."""
    monkeypatch.setattr("uuvtai.sim.sim.Sim", lambda *_: small.sim)
    yield small.sim
    small.sim.privileged = False
    small.sim.use_tree(small.trees["bt"])


COMMAND = ("eval", "--episodes", "3", "--seeds", str(SEED), *SmallSim.OPTIONS)


def test_ceilings_are_rows_of_the_table(borrowed, small, capfd, tmp_path):
    code, out, err = uuv(
        capfd, *COMMAND, "--agent", "bt,bt+truth,oracle", "--run-dir", str(tmp_path / "run"), "--json"
    )
    assert code == 0, err
    document = json.loads(out)
    bt, truth, oracle = document["agents"]
    assert [m["name"] for m in document["agents"]] == ["bt", "bt+truth", "oracle"]
    assert [m["privileged"] for m in document["agents"]] == [False, True, True]
    assert all(set(m) >= set(bt) for m in (truth, oracle))
    paired = [[(d["seed"], d["episode"]) for d in m["episodes_detail"]] for m in document["agents"]]
    assert paired[0] == paired[1] == paired[2] == [(SEED, 0), (SEED, 1), (SEED, 2)]
    for driven in (bt, truth):
        for ours, best in zip(driven["episodes_detail"], oracle["episodes_detail"], strict=True):
            if ours["outcome"] == "success":
                assert best["outcome"] == "success" and best["time_s"] <= ours["time_s"]
    assert {d["outcome"] for d in oracle["episodes_detail"]} <= {"success", "timeout"}
    assert oracle["return_mean"] is None and oracle["env_steps"] == 0
    assert json.loads((tmp_path / "run/eval/result.json").read_text()) == document
    (remainder,) = document["remainder"]
    assert remainder == remainder_of(document["agents"])[0]
    assert (
        remainder["missed"]
        == 3 - bt["outcomes"]["success"]
        == sum(remainder[part] for part in ("sensing", "forecast_decision", "physics"))
    )


def test_the_oracle_alone_is_printed_with_a_dagger(borrowed, capfd, tmp_path):
    code, out, err = uuv(capfd, *COMMAND, "--agent", "oracle", "--run-dir", str(tmp_path / "run"))
    assert code == 0, err
    assert "oracle †" in out and "† oracle is privileged" in out


def test_a_bt_that_comes_after_the_truth_senses_again(borrowed, small, monkeypatch, capfd, tmp_path):
    """The rows of one evaluation do not leak into each other, whatever their order."""
    small.begin_late(monkeypatch, 400)
    code, out, err = uuv(
        capfd, *COMMAND, "--agent", "bt+truth,bt", "--run-dir", str(tmp_path / "a"), "--json"
    )
    assert code == 0, err
    code, alone, err = uuv(capfd, *COMMAND, "--agent", "bt", "--run-dir", str(tmp_path / "b"), "--json")
    assert code == 0, err
    truth, bt = json.loads(out)["agents"]
    assert (
        bt["episodes_detail"] == json.loads(alone)["agents"][0]["episodes_detail"] != truth["episodes_detail"]
    )


def test_failures_of_a_privileged_tree_are_replayed_with_the_truth(borrowed, capfd, tmp_path):
    """A replay that ended otherwise than the episode would be refused."""
    options = ["--agent", "straight+truth,oracle", "--explain", "--explain-record", "0", "--json"]
    code, out, err = uuv(capfd, *COMMAND, *options, "--run-dir", str(tmp_path / "run"))
    assert code == 0, err
    straight, oracle = json.loads(out)["agents"]
    assert len(straight["explain"]) == 3 - straight["outcomes"]["success"] > 0
    assert "explain" not in oracle
    assert [m["name"] for m in json.loads((tmp_path / "run/eval/explain.json").read_text())["agents"]] == [
        "straight+truth"
    ]


def test_what_is_missing_is_split_by_hand():
    def entry(name, *won):
        details = [{"seed": 0, "episode": i, "outcome": "success" if i in won else "ttc"} for i in range(10)]
        return {"name": name, "episodes": 10, "episodes_detail": details}

    entries = [
        entry("bt", 0, 1, 2, 3),
        entry("planner", 0),
        entry("bt+truth", 1, 2, 3, 4, 5, 6),
        entry("oracle", *range(9)),
    ]
    parts = {"sensing": 2, "forecast_decision": 3, "physics": 1, "lost_with_truth": 1}
    assert remainder_of(entries) == [{"agent": "bt", "episodes": 10, "missed": 6, **parts}]
    assert remainder_of(entries[:3]) == []


def test_scenarios_are_those_that_are_played_in_any_batch(small):
    """More jobs than rows, in another order."""
    jobs = [Job(SEED, episode) for episode in (9, 2, 5, 1, 7, 8, 3, 0, 4, 6)]
    found = dict(zip(jobs, scenarios_of(small.sim, jobs), strict=True))
    assert not small.sim.rows(small.sim.s.clock.running).any()
    small.begin([4, 2], seed=SEED)
    starts = small.sim.rows(small.sim.s.mission.start_w)
    assert found[Job(SEED, 4)]["start"] == starts[0].tolist()
    assert found[Job(SEED, 2)]["start"] == starts[1].tolist()
    assert len(found[Job(SEED, 4)]["obstacles"]) == 14


def test_a_tree_of_the_users_own_may_have_a_plus_in_its_name(tmp_path):
    file = tmp_path / "mine+yours.xml"
    file.write_text('<root BTCPP_format="4"><BehaviorTree ID="t"><DriveStraight/></BehaviorTree></root>')
    plain, answer = load_agents([str(file), f"{file}+truth"])
    assert (plain.name, plain.privileged, answer.name, answer.privileged) == (
        "mine+yours", False, "mine+yours+truth", True,
    )  # fmt: skip
