"""A stack as a row of its own: which simulator it gets, the same episodes, its entry in the table."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.command import Quiet
from uuvtai.config.loader import STACK_SECTIONS, ConfigError, load_config, tree_of_stack, with_stack
from uuvtai.evaluation.agents import AgentSpec, differences, load_agents
from uuvtai.evaluation.evaluate import Request, compare
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.sim import Sim


def test_a_stacks_name_is_an_agent_with_its_own_config_and_tree(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("extends: paper\ntree: planner\n")
    bt, paper, with_truth, own = load_agents(["bt", "paper", "paper+truth", str(mine)])
    config = load_config("pool")
    assert (bt.name, bt.stack, bt.document()) == ("bt", None, {}) and bt.config_of(config) is config
    assert (paper.name, paper.privileged, paper.tree.types) == ("paper", False, bt.tree.types)
    assert paper.document() == {"stack": {"preset": "paper", "tree": "bt"}}
    assert paper.config_of(config).voronoi.use == "fused" == with_truth.config_of(config).voronoi.use
    assert (with_truth.name, with_truth.privileged, own.name) == ("paper+truth", True, "mine")
    assert own.tree.types != bt.tree.types


def test_an_agent_that_is_neither_preset_nor_file_is_refused():
    with pytest.raises(
        ConfigError, match="--agent papr: is no preset, file or run folder; did you mean 'paper'"
    ):
        load_agents(["papr"])
    with pytest.raises(ConfigError, match=r"nowhere.yaml.*no such file"):
        load_agents(["nowhere.yaml"])


def test_a_stack_touches_nothing_that_makes_an_episode():
    """World, vehicle, sensors, termination check, reward and columns are the request's: rows are paired."""
    config = load_config("gauntlet", "harsh", overrides={"observation.n_track": 2})
    other = with_stack(config, "paper")
    same = set(type(config).model_fields) - set(STACK_SECTIONS)
    assert {
        "world", "vehicle", "actuation", "disturbance", "sensors", "traffic", "observation", "reward",
        "episode", "runtime",
    } == same  # fmt: skip
    assert all(getattr(other, name) == getattr(config, name) for name in same)
    assert any(getattr(other, name) != getattr(config, name) for name in STACK_SECTIONS)


def test_a_policy_that_meets_another_stack_than_in_training_is_told():
    """With the option that gives it its own, where a preset is that."""
    config, tree = load_config("pool"), read_tree("bt")

    def told(trained, now=config):
        return differences(AgentSpec("mine", tree, SimpleNamespace(config=trained)), now)

    paper = with_stack(config, "paper")
    assert told(config) == told(paper, paper) == differences(AgentSpec("bt", tree), config) == ""
    assert told(paper).startswith("mine drives another stack than in its training: tracking.")
    assert told(paper).endswith(" more; as it was trained: --set stack=paper") and len(told(paper)) < 260
    found = told(load_config("pool", overrides=["behavior.caution=0.7"]))
    assert found.endswith("training: behavior.caution = 1.0 (trained with 0.7)")


@pytest.fixture(scope="module")
def compared(small, tmp_path_factory):
    """The session's simulator stands for both, to compile none: what each row asked for is kept."""
    asked, config = [], small.config
    request = Request(
        config=config, world="pool", sensors="paper", agents=["bt", "paper"], seeds=[5],
        episodes=2, num_envs=small.N,
        record=1, device="cpu", run_dir=tmp_path_factory.mktemp("runs") / "run",
    )  # fmt: skip

    def made(config, num_envs, tree, device):
        assert (num_envs, device) == (small.N, "cpu")
        asked.append(config)
        small.sim.use_tree(tree)
        return small.sim

    with pytest.MonkeyPatch.context() as patch:
        small.begin_late(patch, 100)
        patch.setattr("uuvtai.sim.sim.Sim", made)
        found = compare(request, Quiet())
    small.sim.use_tree(small.trees["bt"])
    assert asked == [config, with_stack(config, "paper")]
    assert asked[1].voronoi.use == "fused" and not asked[1].forecast.use_turn_rate
    return found


def test_bt_and_paper_are_two_rows_of_one_table_and_recorded(compared):
    result, folder = compared
    bt, paper = result["agents"]
    assert (bt["name"], paper["name"], paper["stack"]["tree"]) == ("bt", "paper", tree_of_stack("paper"))
    assert [(d["seed"], d["episode"]) for d in bt["episodes_detail"]] == [
        (d["seed"], d["episode"]) for d in paper["episodes_detail"]
    ]
    assert len(result["paired"]) == 1
    assert (folder / "eval/trees/paper.xml").read_text() == (folder / "eval/trees/bt.xml").read_text()
    assert sorted(log.name for log in (folder / "logs").iterdir()) == [
        "bt_seed5_episode0.mcap",
        "paper_seed5_episode0.mcap",
    ]
    assert json.loads((folder / "eval/result.json").read_text())["agents"][1]["stack"]["preset"] == "paper"


def test_the_papers_stack_plans_and_drives(small):
    """Its kernels differ from those of all other tests by more than numbers; those of the best one:
    ``tests/learning/test_learned_forecast.py``."""
    sim = Sim(with_stack(small.config, "paper"), small.N, read_tree(tree_of_stack("paper")))
    every = torch.ones(small.N, dtype=torch.int32)
    sim.reset(every, 5 * every, torch.arange(small.N, dtype=torch.int32))
    for _ in range(60):
        sim.step()
    assert (sim.rows(sim.s.route.n_way) > 0).all()
    moved = sim.rows(sim.s.vehicle.pos_w) - sim.rows(sim.s.mission.start_w)
    assert np.hypot(*moved[:, :2].T).min() > 0.1
    sim.close()


def test_what_a_stack_keeps_from_set_is_told():
    """An agent's stack wins over ``--set`` in its own row: nobody should think that his key counted."""
    best, bt = load_agents(["best", "bt"])
    asked = load_config(overrides={"behavior.slow_fraction": 0.5, "behavior.travel_diagonal": True})
    assert differences(best, asked) == (
        "best: its stack has behavior.slow_fraction = 1.0, not 0.5; write a stack that 'extends: best'"
    )
    assert differences(bt, asked) == differences(best, load_config("gauntlet_inertial")) == ""
