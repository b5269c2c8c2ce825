"""The environment: automatic resets, numbering, ends, zero copy, the table, and what it refuses."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

import uuvtai
from tests.conftest import configure, near_horizon
from uuvtai.common.enums import OUTCOMES
from uuvtai.config.loader import ConfigError
from uuvtai.envs.vector_env import VectorEnv, observation_sha256

N = 8
SEED = 3

RETURN_ROUNDING = 1e-3
"""Sums of some thousand float32 rewards, in the simulator and here."""


@pytest.fixture(scope="module")
def env(small):
    """One environment on the session's simulator; each test begins with a reset."""
    small.sim.use_tree(small.trees["bt"])
    with VectorEnv(small.sim, seed=SEED) as env:
        yield env


def full(action):
    return torch.tensor(action, dtype=torch.float32).repeat(N, 1)


def column(env, obs, name):
    return obs[:, next(c.slice for c in env.observation_table if c.name == name)]


def test_reset_begins_the_episodes_of_the_seed(env):
    obs, info = env.reset(seed=SEED)
    assert info["episode"].tolist() == list(range(N)) and info["seed"].tolist() == [SEED] * N
    assert obs.shape == (N, env.num_obs) and obs.dtype == torch.float32 and torch.isfinite(obs).all()
    first = obs.clone()
    assert not torch.equal(env.reset(seed=SEED + 1)[0], first)
    assert torch.equal(env.reset(seed=SEED)[0], first)
    _obs, info = env.reset()
    assert info["episode"].tolist() == list(range(N, 2 * N)), "a reset without a seed goes on"


def test_an_episode_that_ends_is_followed_by_its_rows_next_one_in_the_same_step(env):
    """Final observation, outcome and sums are the old episode's, the observation is the new one's."""
    env.reset(seed=SEED)
    total, steps, last = np.zeros(N), 0, torch.zeros(0)
    ended = torch.zeros(N, dtype=torch.bool)
    while not ended.any() and steps < 1500:
        steps += 1
        obs, reward, terminated, truncated, info = env.step(full([1, 0, 0, 0]))
        total += reward.numpy()
        ended = terminated | truncated
        if not ended.any():
            assert torch.equal(info["final_obs"], obs), "where nothing ends, the step led to what is observed"
            last = obs.clone()
    row, going = int(ended.nonzero()[0]), ~ended
    assert going.any(), "some rows must go on to compare with"
    obs, info = obs.clone(), {name: value.clone() for name, value in info.items()}
    assert OUTCOMES[info["outcome"][row]] in ("collision", "ttc", "out_of_tank") and terminated[row]
    assert not truncated[row]
    assert (info["outcome"][going] == 0).all()
    assert info["episode"].tolist() == [i + N if ended[i] else i for i in range(N)]
    assert info["episode_steps"].tolist() == [steps] * N
    np.testing.assert_allclose(info["episode_return"], total, atol=RETURN_ROUNDING)
    assert torch.equal(info["final_obs"][going], obs[going])
    moved = (column(env, info["final_obs"], "goal") - column(env, last, "goal")).norm(dim=1)
    assert moved[row] < 0.1, "one step from the observation before"
    # the final observation is the one that a simulator without resets shows after as many steps
    env.reset(seed=SEED)
    for _ in range(steps):
        env.sim.step(full([1, 0, 0, 0]))
    assert torch.equal(env.sim.observation, info["final_obs"])
    # the new observation is the one of that episode begun afresh
    mask = torch.zeros(N, dtype=torch.bool)
    env.reset(seed=SEED)
    mask[row] = True
    again, _info = env.reset(mask=mask)
    assert torch.equal(again[row], obs[row])
    _obs, _reward, _terminated, _truncated, info = env.step(full([0, 0, 0, 0]))
    assert info["episode_steps"][row] == 1


def test_the_rewards_terms_add_up_to_it(env):
    env.reset(seed=SEED)
    _obs, reward, _terminated, _truncated, info = env.step(full([0.5, 0.0, 0.0, 0.1]))
    assert info["reward_terms"].shape == (N, len(env.reward_terms))
    assert torch.allclose(info["reward_terms"].sum(dim=1), reward, atol=RETURN_ROUNDING)
    assert info["reward_terms"][:, env.reward_terms.index("progress")].any()


def test_the_horizon_truncates(env):
    env.reset(seed=SEED)
    near_horizon(env, [2, 5], steps_left=2)
    *_rest, truncated, _info = env.step(full([0, 0, 0, 0]))
    assert not truncated.any()
    obs, _reward, terminated, truncated, info = env.step(full([0, 0, 0, 0]))
    assert truncated.tolist() == [i in (2, 5) for i in range(N)] and not terminated.any()
    assert [OUTCOMES[o] for o in info["outcome"]] == [
        "timeout" if i in (2, 5) else "running" for i in range(N)
    ]
    assert info["episode"].tolist() == [i + N if i in (2, 5) else i for i in range(N)]
    assert not torch.equal(info["final_obs"][2], obs[2])
    _obs, reward, _terminated, truncated, info = env.step(full([0, 0, 0, 0]))
    assert not truncated.any() and (info["outcome"] == 0).all(), "an end is told once"
    assert torch.equal(info["episode_return"][[2, 5]], reward[[2, 5]]), "a new episode's return begins at 0"


def test_without_autoreset_an_ended_row_rests_until_its_reset(env):
    with VectorEnv(env.sim, seed=SEED, autoreset=False) as resting:
        resting.reset()
        near_horizon(resting, [2], steps_left=1)
        obs, reward, _terminated, truncated, _info = resting.step(full([0.5, 0, 0, 0]))
        assert truncated.tolist() == [i == 2 for i in range(N)] and reward[2] != 0
        last = obs[2].clone()
        obs, reward, _terminated, truncated, info = resting.step(full([0.5, 0, 0, 0]))
        assert truncated[2] and reward[2] == 0 and torch.equal(obs[2], last)
        assert OUTCOMES[info["outcome"][2]] == "timeout"
        resting.reset(mask=truncated.clone())
        _obs, reward, _terminated, truncated, info = resting.step(full([0.5, 0, 0, 0]))
        assert not truncated.any() and info["episode"][2] == N + 2
        assert info["episode_steps"].tolist() == [1 if i == 2 else 3 for i in range(N)]


def test_every_row_goes_on_through_its_own_episodes(env):
    env.reset(seed=SEED)
    for turn in range(1, 4):
        near_horizon(env, range(0, N, turn), steps_left=1)
        before = env.step(full([0, 0, 0, 0]))[4]["episode"].tolist()
    assert before == [i + N * sum(i % turn == 0 for turn in (1, 2, 3)) for i in range(N)]
    assert before == env.sim.rows(env.sim.s.episode.number).tolist()
    assert env.sim.rows(env.sim.s.episode.seed).tolist() == [SEED] * N


def test_a_masked_reset_leaves_the_others_alone(env):
    env.reset(seed=SEED)
    for _ in range(5):
        obs, *_rest = env.step(full([0.5, 0.1, 0, 0.2]))
    before = obs.clone()
    mask = torch.zeros(N, dtype=torch.int32)
    mask[[1, 6]] = 1
    obs, info = env.reset(seed=40, mask=mask)
    others = mask == 0
    assert torch.equal(obs[others], before[others]) and not torch.equal(obs[1], before[1])
    assert info["seed"].tolist() == [40 if m else SEED for m in mask]
    assert info["episode"].tolist() == list(range(N))
    *_rest, info = env.step(full([0, 0, 0, 0]))
    assert info["episode_steps"].tolist() == [1 if m else 6 for m in mask]


def test_the_same_actions_give_the_same_rollout(env):
    actions = 2 * torch.rand(60, N, 4, generator=torch.Generator().manual_seed(0)) - 1

    def rollout():
        env.reset(seed=SEED)
        near_horizon(env, [4], steps_left=30)
        out = []
        for action in actions:
            obs, reward, terminated, truncated, info = env.step(action)
            out.append(
                torch.cat(
                    [obs, reward[:, None], terminated[:, None], truncated[:, None], info["teacher_action"]],
                    dim=1,
                )
            )
        return torch.stack(out)

    first = rollout()
    assert torch.equal(first, rollout())
    assert torch.isfinite(first).all()


def test_teacher_action_drives_as_the_tree_does(env):
    """Following it is what the simulator does alone; another action leaves the teacher's choice apart."""

    def paths(follow):
        _obs, info = env.reset(seed=SEED)
        for _ in range(50):
            if follow:
                *_rest, info = env.step(info["teacher_action"].clone())
            else:
                env.sim.step()
        return env.sim.s.vehicle.pos_w.to_numpy(), info

    followed, info = paths(True)
    np.testing.assert_array_equal(followed, paths(False)[0])
    assert (info["teacher_action"].abs().amax(dim=1) > 0).all()
    *_rest, info = env.step(full([-0.123, 0, 0, 0]))
    assert not (info["teacher_action"] == -0.123).any()
    np.testing.assert_allclose(info["teacher_action"], env.sim.s.behavior.action.to_numpy())


def test_nothing_is_copied(env):
    """The same memory at every step, resets included, and the kernels write it."""

    def tensors(result):
        return [*result[:-1], *result[-1].values()]

    pointers = [t.data_ptr() for t in env.reset(seed=SEED)[1].values()]
    result = env.step(full([0.3, 0, 0, 0]))
    assert [t.data_ptr() for t in result[-1].values()] == pointers
    every = [t.data_ptr() for t in tensors(result)]
    assert len(set(every)) == len(every), "no two of them share memory"
    before = result[0].clone()
    near_horizon(env, [0], steps_left=1)
    result = env.step(full([0.3, 0, 0, 0]))
    assert [t.data_ptr() for t in tensors(result)] == every
    assert result[0].data_ptr() == env.sim.observation.data_ptr()
    assert not torch.equal(result[0], before)


def test_table_covers_every_column_once(env):
    table = env.observation_table
    covered = [i for row in table for i in range(row.slice.start, row.slice.stop)]
    assert covered == list(range(env.num_obs)) == list(range(env.reset(seed=SEED)[0].shape[1]))
    assert len({row.name for row in table}) == len(table)
    assert {row.unit for row in table} <= {"m", "m/s", "rad", "rad/s", "s", "1"}
    assert all(row.frame and row.meaning for row in table)


def test_reward_terms_are_the_reward_and_sum_up_over_the_episode(env):
    """Each term is told with its sign and weight, by step and by episode; a new episode begins at zero."""
    _obs, info = env.reset(seed=SEED)
    assert not info["reward_terms"].any() and not info["episode_terms"].any()
    near_horizon(env, [3], steps_left=4)
    total = torch.zeros(N, len(env.reward_terms))
    for step in range(1, 7):
        _obs, reward, _terminated, truncated, info = env.step(full([0.8, 0.1, 0, 0.2]))
        terms = info["reward_terms"]
        torch.testing.assert_close(terms.sum(dim=1), reward)
        total += terms
        torch.testing.assert_close(info["episode_terms"], total)
        torch.testing.assert_close(info["episode_terms"].sum(dim=1), info["episode_return"])
        assert truncated[3] == (step == 4)
        total[truncated] = 0
    named = dict(zip(env.reward_terms, terms.T, strict=True))
    weights = env.config.reward
    assert (named["alive"] == weights.alive).all() and (named["effort"] < 0).all()
    assert (named["path_distance"] < 0).all()
    assert env.outcomes == OUTCOMES and not named["success"].any()


def test_leaf_is_the_node_whose_action_is_told(env):
    """The straight tree has one leaf, acting in every step; the teacher's leaves are actions of the tree."""
    _obs, info = env.reset(seed=SEED)
    seen = set()
    for _ in range(30):
        *_rest, info = env.step(info["teacher_action"].clone())
        np.testing.assert_array_equal(info["leaf"], env.sim.s.behavior.leaf.to_numpy())
        seen |= set(info["leaf"].tolist())
    actions = {
        i
        for i, kind in enumerate(env.sim.tree.types)
        if kind in ("BackOff", "Hold", "Evade", "Unstick", "FollowRoute")
    }
    assert seen <= actions and "FollowRoute" in {env.node_names[i] for i in seen}


def test_columns_find_every_group(env):
    obs, _info = env.reset(seed=SEED)
    assert list(env.columns) == [row.name for row in env.observation_table]
    assert env.columns["goal"] == slice(0, 3) and env.columns["sector_range"] == slice(12, 24)
    np.testing.assert_allclose(
        obs[:, env.columns["sector_range"]], env.sim.s.observation.sector_range_m.to_numpy()
    )


def test_obstacles_and_advice_stand_behind_the_paper_observation(small, env, monkeypatch):
    """Switched on by the config: what was there stays, and the tree's action is the one that is told."""
    plain = VectorEnv(small.sim, seed=SEED)
    wanted = [plain.reset()[0].clone(), *(plain.step(full([0.6, 0, 0, 0.05]))[0].clone() for _ in range(80))]
    more = small.config.observation.model_copy(update={"n_track": 4, "behavior": True})
    configure(monkeypatch, small.sim, small.config.model_copy(update={"observation": more}))
    with VectorEnv(small.sim, seed=SEED) as shown:
        assert shown.observation_sha256 != plain.observation_sha256
        assert list(shown.columns)[-4:] == [
            "teacher_action", "behavior_conflict", "behavior_evade_cost", "behavior_class",
        ]  # fmt: skip
        obs, info = shown.reset()
        seen = 0
        for step, paper in enumerate(wanted):
            assert torch.equal(obs[:, : plain.num_obs], paper), f"step {step}"
            assert torch.equal(obs[:, shown.columns["teacher_action"]], info["teacher_action"])
            assert (obs[:, shown.columns["behavior_class"]].sum(dim=1) == (info["leaf"] >= 0)).all()
            moving = (small.sim.s.tracks.alive.to_numpy() * small.sim.s.tracks.moving.to_numpy()).sum(axis=1)
            np.testing.assert_array_equal(
                obs[:, shown.columns["obstacle_valid"]].sum(dim=1), moving.clip(max=4)
            )
            seen += int(moving.sum())
            obs, *_rest, info = shown.step(full([0.6, 0, 0, 0.05]))
        assert seen > 0, "no obstacle was ever tracked"
        obs = obs.clone()
        assert torch.equal(shown.restore(shown.capture())[0], obs)


def test_fingerprint_tells_observations_apart(env):
    """It changes with a name, a width, a unit, a frame or the order, and with nothing else."""
    table = env.observation_table
    first, second, *rest = table
    assert env.observation_sha256 == observation_sha256(table) and len(env.observation_sha256) == 64
    assert (
        observation_sha256((replace(first, meaning="another wording"), second, *rest))
        == env.observation_sha256
    )
    changes = (
        (second, first, *rest),
        (replace(first, name="goals"), second, *rest),
        (replace(first, slice=slice(0, 2)), second, *rest),
        (replace(first, unit="km"), second, *rest),
        (replace(first, frame="world"), second, *rest),
        table[:-1],
    )
    assert (
        len({observation_sha256(changed) for changed in changes} | {env.observation_sha256})
        == len(changes) + 1
    )


def test_gradients_do_not_leak_into_the_simulator(env):
    env.reset(seed=SEED)
    obs, reward, *_rest = env.step(full([0.1, 0, 0, 0]).requires_grad_() * 2)
    assert not obs.requires_grad and not reward.requires_grad and not env.sim.action.requires_grad


@pytest.mark.parametrize(
    ("action", "error", "words"),
    [
        (np.zeros((N, 4), np.float32), TypeError, "float32 torch tensor, got a ndarray"),
        (torch.zeros(N, 4, dtype=torch.float64), TypeError, "torch.float64"),
        (torch.zeros(N, 3), ValueError, r"shape \(8, 4\)"),
        (torch.zeros(4), ValueError, r"shape \(8, 4\)"),
        (torch.zeros(N, 4, device="meta"), ValueError, "on cpu"),
        (
            torch.tensor([[0.0, 0, 0, 0]] * 6 + [[0, float("nan"), 0, 0], [0, 0, 0, float("inf")]]),
            ValueError,
            "not finite in env 6, 7",
        ),
    ],
)
def test_bad_actions_are_refused_and_change_nothing(env, action, error, words):
    env.reset(seed=SEED)
    with pytest.raises(error, match=words):
        env.step(action)
    assert not env.sim.rows(env.sim.s.clock.step).any()


def test_huge_actions_are_finite(env):
    """Their sum is not, which is what is looked at first."""
    env.reset(seed=1)
    assert torch.isfinite(env.step(torch.full((N, 4), 3e38))[0]).all()


def test_unchecked_nan_asks_for_nothing(env):
    env.reset(seed=SEED)
    env.check_actions = False
    obs, *_rest = env.step(full([float("nan")] * 4))
    env.check_actions = True
    assert torch.isfinite(obs).all()
    assert not env.sim.s.actuation.command.to_numpy().any()


def test_misuse_is_told(small, env):
    fresh = VectorEnv(small.sim)
    with pytest.raises(RuntimeError, match="step before reset"):
        fresh.step(full([0, 0, 0, 0]))
    with pytest.raises(RuntimeError, match="first reset must begin every env"):
        fresh.reset(mask=torch.arange(N) == 0)
    with pytest.raises(ValueError, match="seed -1"):
        fresh.reset(seed=-1)
    with pytest.raises(TypeError, match="seed must be an int"):
        VectorEnv(small.sim, seed=1.5)
    with pytest.raises(TypeError, match="mask must be a torch tensor"):
        env.reset(mask=[True] * N)
    with pytest.raises(ValueError, match=r"shape \(8,\)"):
        env.reset(mask=torch.ones(3, dtype=torch.bool))


def test_a_closed_environment_stays_closed(small, env):
    other = VectorEnv(small.sim)
    other.close()
    other.close()
    with pytest.raises(RuntimeError, match="closed"):
        other.reset()
    with pytest.raises(RuntimeError, match="closed"):
        other.step(full([0, 0, 0, 0]))
    env.reset(seed=SEED)
    assert not torch.equal(env.step(full([1, 0, 0, 0]))[0].clone(), env.step(full([1, 0, 0, 0]))[0]), (
        "the other one still works"
    )


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"world": "pol"}, ConfigError, "pool"),
        ({"sensors": "perfect"}, ConfigError, "paper"),
        ({"teacher": "oracle"}, ConfigError, "planner"),
        ({"overrides": {"world.n_dynamics": 3}}, ConfigError, "n_dynamic"),
        ({"num_envs": 0}, ValueError, "at least 1 env"),
        ({"num_envs": 2.0}, TypeError, "num_envs must be an int"),
        ({"seed": -5}, ValueError, "seed -5"),
        ({"device": "tpu"}, ValueError, "unknown device"),
    ],
)
def test_make_refuses_what_cannot_be_made(arguments, error, words):
    with pytest.raises(error, match=words):
        uuvtai.make(**arguments)


def test_import_is_light():
    program = (
        "import sys, uuvtai; uuvtai.make; print([m for m in ('taichi', 'torch', 'numpy', 'pydantic') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"
