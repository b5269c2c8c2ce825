"""The batch for Stable-Baselines3 and rsl_rl: ends, last observations, time-outs, seeds, refusals."""

import numpy as np
import pytest
import torch

from tests.conftest import near_horizon
from uuvtai.envs.gymnasium import UuvVectorEnv

N = 8
SEED = 3


@pytest.fixture
def adapter_of():
    """From a trainer to our adapter; imported here, for rsl_rl takes two seconds."""

    def of(trainer):
        pytest.importorskip(trainer, reason=f"{trainer} is not installed")
        if trainer == "rsl_rl":
            from uuvtai.envs.rsl_rl import RslRlVecEnv

            return RslRlVecEnv
        from uuvtai.envs.sb3 import Sb3VecEnv

        return Sb3VecEnv

    return of


@pytest.fixture
def batch(small):
    """Batches on the session's simulator."""
    small.sim.use_tree(small.trees["bt"])
    return lambda **options: UuvVectorEnv(sim=small.sim, **options)


def test_sb3_gets_last_observations_and_statistics(batch, adapter_of):
    envs = batch(hold_steps=2)
    adapter = adapter_of("stable_baselines3")(envs)
    adapter.seed(SEED)
    first = adapter.reset()
    np.testing.assert_array_equal(first, batch().reset(seed=SEED)[0])
    adapter.seed(SEED)
    adapter.reset()
    near_horizon(envs.native, [5], steps_left=4)
    assert adapter.step(np.zeros((N, 4), np.float32))[3] == [{}] * N
    obs, reward, ended, infos = adapter.step(np.zeros((N, 4), np.float32))
    assert ended.tolist() == [i == 5 for i in range(N)] and reward.shape == (N,)
    assert [sorted(info) for info in infos] == [
        ["TimeLimit.truncated", "episode", "is_success", "terminal_observation"] if i == 5 else []
        for i in range(N)
    ]
    answer = infos[5]
    assert answer["TimeLimit.truncated"] and not answer["is_success"]
    assert answer["episode"]["l"] == envs.native.config.episode.horizon_steps // 2
    goal = envs.native.columns["goal"]
    assert (
        np.abs(answer["terminal_observation"][goal] - first[5, goal]).max()
        < 0.2
        < np.abs(obs[5, goal] - first[5, goal]).max()
    )
    assert adapter.env_is_wrapped(object) == [False] * N and adapter.get_attr("num_envs") == [N] * N
    for indices, count in ((0, 1), ([0, 1], 2), (np.array([1]), 1), (range(2), 2), ([], 0)):
        assert (
            len(adapter.env_is_wrapped(object, indices))
            == len(adapter.get_attr("num_envs", indices))
            == count
        )
    assert adapter.has_attr("num_envs") and not adapter.has_attr("nothing_of_the_kind")
    for name, indices, error in (("nothing_of_the_kind", None, AttributeError), ("num_envs", N, IndexError)):
        with pytest.raises(error):
            adapter.get_attr(name, indices)
    for use in (lambda: adapter.set_attr("x", 1), lambda: adapter.env_method("x")):
        with pytest.raises(NotImplementedError, match="no attributes or methods of single envs"):
            use()
    adapter.close()
    with pytest.raises(RuntimeError, match="closed"):
        adapter.reset()


def test_rsl_rl_gets_time_outs_apart(batch, adapter_of):
    envs = batch(backend="torch", hold_steps=2)
    adapter = adapter_of("rsl_rl")(envs, seed=SEED)
    assert adapter.max_episode_length == envs.native.config.episode.horizon_steps // 2
    before = adapter.get_observations()["policy"]
    kept = before.clone()
    near_horizon(envs.native, [5], steps_left=4)
    _obs, _reward, ended, extras = adapter.step(torch.zeros(N, 4))
    assert not ended.any() and extras["log"] == {} and torch.equal(before, kept)
    obs, reward, ended, extras = adapter.step(torch.zeros(N, 4))
    assert ended.tolist() == [i == 5 for i in range(N)]
    assert extras["time_outs"].tolist() == ended.float().tolist()
    assert set(extras["log"]) == {"/episode_return", "/is_success"} and extras["log"]["/is_success"] == 0
    assert adapter.episode_length_buf.tolist() == [0 if i == 5 else 2 for i in range(N)]
    assert obs.batch_size == (N,) and torch.equal(obs["policy"], adapter.get_observations()["policy"])
    assert reward.shape == (N,)
    with pytest.raises(RuntimeError, match="init_at_random_ep_len=False"):
        adapter.episode_length_buf = torch.zeros(N)


@pytest.mark.parametrize(
    ("trainer", "options", "words"),
    [
        ("stable_baselines3", {"backend": "torch"}, "'numpy', got SAME_STEP and 'torch'"),
        ("stable_baselines3", {"autoreset_mode": "NextStep"}, "needs SAME_STEP .* got NEXT_STEP"),
        ("rsl_rl", {}, "'torch', got SAME_STEP and 'numpy'"),
        ("rsl_rl", {"backend": "torch", "autoreset_mode": "Disabled"}, "got DISABLED"),
    ],
)
def test_other_modes_are_refused(batch, adapter_of, trainer, options, words):
    with pytest.raises(ValueError, match=words):
        adapter_of(trainer)(batch(**options))
