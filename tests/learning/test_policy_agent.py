"""A policy driving: equal in any batch, memory per row, and checkpoints that do not fit are refused."""

import hashlib
import itertools
import json

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from tests.command import run_cli
from tests.small_sim import SmallSim
from uuvtai.common.presets import PRESET_DIR
from uuvtai.config.loader import load_training
from uuvtai.envs.vector_env import VectorEnv
from uuvtai.evaluation.agents import AgentSpec, load_agents, observation_of
from uuvtai.evaluation.episodes import jobs_of, run_episodes
from uuvtai.learning import checkpoint
from uuvtai.learning.agents import find_policy
from uuvtai.learning.checkpoint import CheckpointError
from uuvtai.learning.networks import ActorCritic
from uuvtai.learning.policy_agent import CHUNK, PolicyAgent, load_agent
from uuvtai.learning.world_model import WorldModel
from uuvtai.logs.reader import read_head, read_messages
from uuvtai.logs.writer import EpisodeRecorder

N_OBS = 60


def networks(n_obs=N_OBS, seed=0, **config):
    """A policy and a world model that have seen a batch and act decidedly."""
    learning = load_training("smoke", [(f"policy.{key}", value) for key, value in config.items()])
    rng = torch.Generator().manual_seed(seed)
    policy = ActorCritic(n_obs + 2, learning.policy, rng)
    model = WorldModel(n_obs, learning.world_model, rng)
    policy.observation_norm.update(3.0 * torch.randn(500, n_obs + 2, generator=rng))
    model.observation_norm.update(3.0 * torch.randn(500, n_obs, generator=rng))
    with torch.no_grad():
        policy.actor[-1].weight.mul_(30.0)
    return policy, model


def state_of(policy, model, n_obs):
    """What a checkpoint holds of them."""
    return {"policy": policy.state_dict(), "world_model": model.state_dict(), "env": {}}


def flown(policy, model, rows, steps=4):
    """Decisions of a pilot over some steps for the given rows of one fixed stream of observations."""
    stream = 3.0 * torch.randn(steps, 300, N_OBS, generator=torch.Generator().manual_seed(1))
    pilot, out = PolicyAgent(policy, model, len(rows)), []
    for obs in stream:
        decision = pilot.decide(obs[rows])
        columns = (decision.value, decision.residual, decision.uncertainty)
        out.append(torch.cat([decision.action, *(column[:, None] for column in columns)], 1))
        pilot.advance()
    return torch.stack(out)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_row_does_not_depend_on_its_batch_to_the_last_bit(threads):
    policy, model = networks()
    before = torch.get_num_threads()
    expected = flown(policy, model, list(range(300)))
    torch.set_num_threads(threads)
    try:
        for rows in ([0], [7, 3], list(range(CHUNK, CHUNK + 50)), list(range(299, 0, -1))):
            assert torch.equal(flown(policy, model, rows), expected[:, rows])
    finally:
        torch.set_num_threads(before)
    assert expected[:, :, :4].std() > 0.1, "the actions do depend on the observations"
    assert (expected[0, :, 5:7] == 0).all(), "nothing was predicted before the first step"
    assert (expected[1:, :, 5:7] > 0).all()


def test_memory_is_reset_by_row_and_deciding_again_changes_nothing():
    policy, model = networks()
    pilot = PolicyAgent(policy, model, 3)
    obs = torch.randn(3, N_OBS, generator=torch.Generator().manual_seed(2))
    pilot.act(torch.zeros(3, N_OBS))
    first = pilot.decide(obs)
    assert all(torch.equal(a, b) for a, b in zip(first, pilot.decide(obs), strict=True))
    pilot.reset(torch.tensor([0, 1, 0], dtype=torch.int32))
    again = pilot.decide(obs)
    assert again.residual[1] == 0.0
    assert torch.equal(again.action[[0, 2]], first.action[[0, 2]])
    assert not torch.equal(again.action[1], first.action[1])


def test_what_it_thinks_of_the_world_model_is_about_its_own_last_action():
    """By the prediction from the last observation and the action chosen there."""
    policy, model = networks()
    with torch.no_grad():
        model.decoder[-1].weight.mul_(100.0)  # or an untrained prediction would hardly depend on the action
    first, second = 3.0 * torch.randn(2, 3, N_OBS, generator=torch.Generator().manual_seed(4))
    pilot = PolicyAgent(policy, model, 3)
    pilot.act(first)
    own = policy.mean_of(policy.prepared({"x": torch.cat([first, torch.zeros(3, 2)], 1)})).detach()
    assert own.abs().mean() > 0.1
    decision = pilot.decide(second)
    expected = model.features(first, own, second)
    assert torch.allclose(torch.stack([decision.residual, decision.uncertainty], 1), expected, rtol=1e-4)
    assert not torch.allclose(model.features(first, torch.zeros(3, 4), second), expected, rtol=1e-3)
    x = torch.cat([second, expected], 1)
    assert torch.allclose(decision.action, policy.mean_of(policy.prepared({"x": x})).clamp(-1, 1), atol=1e-4)


def test_actions_are_means_within_the_limits_and_nan_does_not_spread():
    policy, model = networks()
    pilot = PolicyAgent(policy, model, 2)
    obs = torch.randn(2, N_OBS)
    clean = pilot.decide(obs).action
    obs[1, 5] = float("nan")
    found = pilot.decide(obs).action
    assert torch.equal(found[0], clean[0])
    assert torch.isfinite(found).all()
    assert (found.abs() <= 1).all()
    x = torch.cat([obs[:1], torch.zeros(1, 2)], 1)
    # other shapes sum in another order
    assert torch.allclose(found[0], policy.mean_of(policy.prepared({"x": x}))[0].clamp(-1, 1), atol=1e-5)


# --------------------------------------------------------------------------------------------- in a simulator


@pytest.fixture(scope="module")
def trained(small, tmp_path_factory):
    """(run folder, config): a run with one checkpoint whose policy fits the session's simulator."""
    folder = tmp_path_factory.mktemp("runs") / "mine"
    config = load_training("smoke", {"world.dynamic_capacity": 9})
    env = VectorEnv(small.sim)
    policy, model = networks(env.num_obs, seed=3)
    with torch.no_grad():
        policy.actor[-1].bias[2] = 3.0  # down or up until something stops it: short episodes
    state = state_of(policy, model, env.num_obs)
    checkpoint.save(
        folder / "checkpoints", 5, state, config, env.observation_table, metrics={"distillation/lambda": 0.25}
    )
    return folder, config


def agent_of(folder, small):
    (agent,) = load_agents([str(folder)], print)
    note = agent.agent_for(small.sim)
    small.sim.use_tree(agent.tree)
    return agent, note


def test_episodes_do_not_depend_on_order_or_neighbours(small, trained, monkeypatch):
    monkeypatch.setattr(small.sim, "observation", None)  # others may have asked for it before
    agent, note = agent_of(trained[0], small)
    assert agent.name == "mine"
    jobs = jobs_of([21], 10)
    results, _ = run_episodes(small.sim, jobs, agent=note.agent)
    backwards, _ = run_episodes(small.sim, jobs[::-1], agent=load_agent(agent.checkpoint, small.N))
    alone, _ = run_episodes(small.sim, jobs[4:5], agent=note.agent)
    answer = [vars(r) | {"ticks": r.ticks.tolist(), "acted": r.acted.tolist()} for r in results]
    assert [
        vars(r) | {"ticks": r.ticks.tolist(), "acted": r.acted.tolist()} for r in backwards[::-1]
    ] == answer
    assert vars(alone[0]) | {"ticks": alone[0].ticks.tolist(), "acted": alone[0].acted.tolist()} == answer[4]
    assert not {r.outcome for r in results} & {"success", "timeout"}, "the policy drove, not the tree"
    assert small.sim.observation is None, "nobody else is made to pay for observations"


def test_the_log_tells_what_the_policy_thought(small, trained, tmp_path):
    agent, note = agent_of(trained[0], small)
    jobs = jobs_of([21], 1)
    recorder = EpisodeRecorder(tmp_path, "pool", agent.name, jobs, policy=note)
    run_episodes(small.sim, jobs, recorder, agent=note.agent)
    log = recorder.paths[jobs[0]]
    run = read_head(log).metadata["uuv.run"]
    assert (run["agent"], run["checkpoint_sha256"]) == ("mine", agent.checkpoint.sha256)
    messages = list(read_messages(log, ("/policy", "/action")))
    outputs = [m.data for m in messages if m.topic == "/policy"]
    actions = [m.data for m in messages if m.topic == "/action"]
    assert all(t["lambda"] == 0.25 and len(t["std"]) == 4 for t in outputs)
    assert outputs[0]["wm_residual"] == 0.0
    assert all(t["wm_residual"] > 0 and t["wm_uncertainty"] > 0 for t in outputs[1:])
    assert {"alive", "progress", "success"} <= set(outputs[0])
    assert all(b["applied"] == a["policy"] for a, b in itertools.pairwise(actions)), (
        "what it chose is what was done next"
    )
    assert any(a["policy"] != a["behavior"] for a in actions)


def test_another_observation_is_refused_before_driving(small, trained):
    agent, _ = agent_of(trained[0], small)
    changed = agent.checkpoint.manifest.model_copy(
        update={"observation_table": agent.checkpoint.manifest.observation_table[:-1]}
    )
    other = checkpoint.Checkpoint(agent.checkpoint.path, changed, agent.checkpoint.config, "")
    with pytest.raises(CheckpointError, match="another observation table"):
        AgentSpec("other", agent.tree, other).agent_for(small.sim)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda state: state.pop("world_model"), "its networks are not those of its config"),
        (lambda state: state["policy"].pop("log_std"), "its networks are not those of its config"),
        (
            lambda state: state["policy"].update(log_std=torch.zeros(3)),
            "its networks are not those of its config",
        ),
        (
            lambda state: state["policy"].update(log_std=torch.full((4,), float("nan"))),
            "log_std is not finite",
        ),
    ],
)
def test_networks_that_cannot_drive_are_refused(small, trained, tmp_path, change, says):
    env = VectorEnv(small.sim)
    policy, model = networks(env.num_obs)
    state = state_of(policy, model, env.num_obs)
    change(state)
    path = checkpoint.save(tmp_path / "checkpoints", 1, state, trained[1], env.observation_table)
    with pytest.raises(CheckpointError, match=says):
        load_agent(checkpoint.open_checkpoint(path), 4)


# ------------------------------------------------------------------------------------------------------ names


def test_a_policy_is_found_by_run_and_by_checkpoint(trained):
    folder, config = trained
    by_run, by_step = (find_policy(str(folder)), find_policy(str(folder / "checkpoints" / "step_000005")))
    manifest = (folder / "checkpoints" / "step_000005" / "manifest.json").read_bytes()
    assert by_run.sha256 == by_step.sha256 == hashlib.sha256(manifest).hexdigest()
    assert load_agents([str(folder / "checkpoints" / "step_000005")], print)[0].name == "mine-step_000005"
    assert observation_of([str(folder)]) == [("observation", config.observation.model_dump(mode="json"))]


def test_the_built_in_policy_arrives(small, monkeypatch, tmp_path, capfd):
    monkeypatch.setattr("uuvtai.sim.sim.Sim", lambda *_arguments: small.sim)
    words = (
        "--agent=policy",
        "--episodes=8",
        "--seeds=3",
        *SmallSim.OPTIONS,
        "--json",
        "--run-dir",
        tmp_path,
    )
    assert run_cli("eval", *words) == 0
    (agent,) = json.loads(capfd.readouterr().out)["agents"]
    assert agent["outcomes"]["success"] >= 7 and agent["checkpoint"]["path"] == "built-in"


def test_the_built_in_policy_drives_on_when_keys_are_renamed(tmp_path, monkeypatch):
    with safe_open(PRESET_DIR / "policy" / checkpoint.MODEL, "pt") as file:
        manifest = json.loads(file.metadata()["manifest"]) | {"config": {"twin": {"gap_m": 1}}}
    (tmp_path / "policy").mkdir()
    arrays = load_file(PRESET_DIR / "policy" / checkpoint.MODEL)
    save_file(arrays, tmp_path / "policy" / checkpoint.MODEL, {"manifest": json.dumps(manifest)})
    monkeypatch.setattr(checkpoint, "PRESET_DIR", tmp_path)
    found = find_policy("policy")
    assert found.config == load_training("policy") and "policy" in found.model()


def test_names_that_are_no_policy(trained, tmp_path):
    with pytest.raises(ValueError, match="is no trained policy"):
        find_policy(str(tmp_path))
    with pytest.raises(ValueError, match="two rows would be called mine"):
        load_agents([str(trained[0]), f"{trained[0]}/"], print)


def test_policies_with_other_columns_are_not_evaluated_together(trained, tmp_path):
    folder, config = trained
    wider = config.model_copy(update={"observation": config.observation.model_copy(update={"n_sector": 16})})
    table = json.loads((folder / "checkpoints/step_000005/manifest.json").read_text())["observation_table"]
    columns = [type("Column", (), row | {"slice": slice(row["first"], row["stop"])}) for row in table]
    checkpoint.save(tmp_path / "other" / "checkpoints", 1, {"policy": {}, "env": {}}, wider, columns)
    with pytest.raises(ValueError, match="evaluate them one by one"):
        observation_of([str(folder), str(tmp_path / "other")])
