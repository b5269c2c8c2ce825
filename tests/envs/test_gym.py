"""Gymnasium's interfaces: checkers of Gymnasium, Stable-Baselines3 and TorchRL, three autoreset modes."""

import hashlib
import importlib
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from tests.conftest import near_horizon
from uuvtai.config.loader import ConfigError
from uuvtai.envs import gymnasium as single
from uuvtai.envs import gymnasium as vector
from uuvtai.envs.gymnasium import ENV_ID, UuvEnv, UuvVectorEnv, bounds, observation_space
from uuvtai.envs.vector_env import VectorEnv
from uuvtai.kernels.planning.observation import placed_columns

N = 8
SEED = 3
MODES = ["SameStep", "NextStep", "Disabled"]
FORWARD = np.tile(np.array([1, 0, 0, 0], np.float32), (N, 1))

RETURN_ROUNDING = 1e-3
"""Sums of some thousand float32 rewards, in the simulator and here."""


@pytest.fixture
def make(small):
    """Batches on the session's simulator."""
    small.sim.use_tree(small.trees["bt"])
    made = []

    def make(**options):
        made.append(UuvVectorEnv(sim=small.sim, **options))
        return made[-1]

    yield make
    for envs in made:
        envs.close()


@pytest.fixture
def registered(small, monkeypatch):
    """``gymnasium.make`` builds on the session's simulator; what it was asked for is kept."""
    asked = []

    def simulator(*options):
        asked.append(options)
        return small.sim

    for module in (single, vector):
        monkeypatch.setattr(module, "simulator", simulator)
    monkeypatch.setattr(small.sim, "close", lambda: None)  # other tests go on with it
    return asked


def random_actions(steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, N, 4)).astype(np.float32)


# ------------------------------------------------------------------------------------------- other's checkers


def test_gymnasium_checks_the_env_that_make_gives(registered):
    env = gymnasium.make(ENV_ID, world="pool", overrides={"world.n_dynamic": 3}, render_mode="rgb_array")
    with pytest.warns(UserWarning) as answer:
        check_env(env.unwrapped)
    assert all("infinity" in str(warning.message) for warning in answer), (
        "position errors and velocities have no bounds; no other complaint"
    )
    assert registered[0] == ("pool", 1, None, None, {"world.n_dynamic": 3}, "cpu", "bt")
    env.close()
    env.close()


def test_stable_baselines3_checks_the_env(small):
    env_checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env_checker.check_env(UuvEnv(sim=small.sim), warn=True)


@pytest.mark.parametrize("mode", ["single", "SameStep", "Disabled"])
def test_torchrl_checks_specs_and_keeps_the_last_observations(small, make, mode):
    envs = pytest.importorskip("torchrl.envs")
    env = UuvEnv(sim=small.sim) if mode == "single" else make(autoreset_mode=mode)
    wrapped = envs.GymWrapper(env)
    envs.check_env_specs(wrapped)
    if mode == "single":
        return
    wrapped.set_seed(0)
    first = wrapped.reset()
    near_horizon(env.native, [2], steps_left=3)
    rollout = wrapped.rollout(6, break_when_any_done=False, auto_reset=False, tensordict=first)
    assert rollout["next", "truncated"][2].flatten().tolist() == [False, False, True, False, False, False]
    goal = env.native.columns["goal"]
    jump = (rollout["next", "observation"][2, :, goal] - rollout["observation"][2, :, goal]).norm(dim=1)
    assert (jump < 0.2).all(), "next is where the step led to, not where the following episode begins"


def test_make_vec_gives_the_batch(registered):
    envs = gymnasium.make_vec(ENV_ID, num_envs=16, world="maze", autoreset_mode="NextStep")
    assert isinstance(envs, UuvVectorEnv) and envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert registered == [("maze", 16, None, None, None, "cpu", "bt")]
    assert UuvVectorEnv.__bases__ == (gymnasium.vector.VectorEnv,)
    assert "autoreset_mode" not in UuvVectorEnv.metadata


# ------------------------------------------------------------------------------------------------ conformance


def test_spaces_hold_what_comes(make):
    envs = make()
    assert envs.action_space.shape == (N, 4)
    assert envs.single_action_space == gymnasium.spaces.Box(-1, 1, (4,), np.float32)
    assert envs.single_observation_space.shape == (envs.native.num_obs,)
    assert envs.observation_space.dtype == np.float32
    obs, _info = envs.reset(seed=SEED)
    assert obs in envs.observation_space
    for action in random_actions(60):
        obs, reward, terminated, truncated, _info = envs.step(action)
        assert obs in envs.observation_space
        assert reward.shape == (N,) and terminated.dtype == truncated.dtype == np.bool_


def test_every_bound_is_of_a_column(small):
    everything = small.config.observation.model_copy(update={"n_track": 2, "behavior": True})
    assert set(bounds(small.config)) <= {column.name for column, _first, _width in placed_columns(everything)}
    table = VectorEnv(small.sim).observation_table
    space, places = observation_space(table, small.config), {column.name: column.slice for column in table}
    assert (space.high[places["sector_range"]] == small.config.sensors.sonar.max_range_m).all()
    assert np.isinf(space.low[places["goal"]]).all()


def test_the_docs_list_the_columns(small):
    features = small.config.observation.model_copy(update={"n_track": 1, "behavior": True})
    per = {"": "", "sector": " a sector", "body": " an obstacle"}
    rows = [
        f"| `{column.name}` | {column.width}{per[column.per]} | {column.unit} | {column.frame} | "
        f"{column.meaning} |"
        for column, _first, _width in placed_columns(features)
    ]
    answer = (Path(__file__).parents[2] / "docs/extend.md").read_text().splitlines()
    first = answer.index(rows[0])
    assert answer[first : first + len(rows)] == rows


def test_same_step_tells_the_end_beside_the_next_beginning(make):
    envs = make()
    envs.reset(seed=SEED)
    near_horizon(envs.native, [2, 5], steps_left=2)
    *_rest, info = envs.step(FORWARD)
    assert not any(key.lstrip("_").startswith("final") for key in info), "told only where an episode ends"
    _obs, reward, _terminated, truncated, info = envs.step(FORWARD)
    ended = np.isin(np.arange(N), [2, 5])
    np.testing.assert_array_equal(truncated, ended)
    for key in ("_final_obs", "_final_info"):
        np.testing.assert_array_equal(info[key], ended)
    final = info["final_info"]
    assert all((final[key] == ended).all() for key in final if key.startswith("_"))
    assert {"_outcome", "_episode_return"} <= final.keys()
    assert [envs.native.outcomes[code] for code in final["outcome"][ended]] == ["timeout", "timeout"]
    assert (final["episode_steps"][ended] == envs.native.config.episode.horizon_steps).all()
    assert reward[2] != 0
    assert [value is None for value in info["final_obs"]] == (~ended).tolist()
    assert (info["outcome"] == 0).all() and (info["episode_steps"] == np.where(ended, 0, 2)).all()
    assert info["_outcome"].all()
    assert info["episode_number"].tolist() == [row + N * ended[row] for row in range(N)]


def test_next_step_ignores_the_action_after_an_end(make):
    envs = make(autoreset_mode="NextStep")
    first, _info = envs.reset(seed=SEED)
    near_horizon(envs.native, [2], steps_left=1)
    obs, _reward, terminated, truncated, info = envs.step(FORWARD)
    assert truncated[2] and envs.native.outcomes[info["outcome"][2]] == "timeout" and "final_obs" not in info
    goal = envs.native.columns["goal"]
    assert np.abs(obs[2, goal] - first[2, goal]).max() < 0.2, "the last observation of the episode that ended"
    obs, reward, terminated, truncated, info = envs.step(FORWARD)
    assert reward[2] == 0 and not terminated.any() and not truncated.any()
    assert info["episode_steps"].tolist() == [0 if i == 2 else 2 for i in range(N)]
    assert info["episode_number"][2] == N + 2 and np.abs(obs[2, goal] - first[2, goal]).max() > 0.2
    *_rest, info = envs.step(FORWARD)
    assert info["episode_steps"].tolist() == [1 if i == 2 else 3 for i in range(N)]


def test_disabled_leaves_resets_to_the_user(make):
    envs = make(autoreset_mode=AutoresetMode.DISABLED)
    before, _info = envs.reset(seed=SEED)
    near_horizon(envs.native, [2], steps_left=1)
    before, _reward, _terminated, truncated, _info = envs.step(FORWARD)
    with pytest.raises(RuntimeError, match=r"after the end of env 2: call reset\(options="):
        envs.step(FORWARD)
    after, info = envs.reset(options={"reset_mask": truncated})
    np.testing.assert_array_equal(np.delete(after, 2, 0), np.delete(before, 2, 0))
    np.testing.assert_array_equal(info["_episode_number"], truncated)
    assert info["episode_number"][2] == N + 2
    *_rest, info = envs.step(FORWARD)
    assert info["episode_steps"].tolist() == [1 if i == 2 else 2 for i in range(N)]


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_plays_the_same_episodes(make, mode):
    """Rows are those of the environment underneath, which begins episodes in the same step."""
    envs, per_row = make(autoreset_mode=mode), [[] for _ in range(N)]
    actions = random_actions(40)

    def end_soon(native):
        for row, left in ((1, 5), (4, 9)):
            native.sim.s.clock.step[row] = native.config.episode.horizon_steps - left

    envs.reset(seed=SEED)
    end_soon(envs.native)
    count = np.zeros(N, int)
    for _ in range(30):
        action = np.stack([actions[count[row], row] for row in range(N)])
        obs, reward, terminated, truncated, info = envs.step(action)
        began = info["episode_steps"] == 0 if mode == "NextStep" else np.zeros(N, bool)
        for row in np.flatnonzero(~began):
            ended = terminated[row] or truncated[row]
            per_row[row].append(
                (info["final_obs"][row] if ended and mode == "SameStep" else obs[row], reward[row], ended)
            )
        count += ~began
        if mode == "Disabled" and (terminated | truncated).any():
            envs.reset(options={"reset_mask": terminated | truncated})
    native = VectorEnv(envs.native.sim, seed=SEED)
    native.reset()
    end_soon(native)
    for step in range(28):
        _obs, reward, terminated, truncated, info = native.step(torch.from_numpy(actions[step]))
        for row in range(N):
            told_obs, told_reward, told_end = per_row[row][step]
            np.testing.assert_array_equal(told_obs, info["final_obs"][row])
            assert told_reward == reward[row] and told_end == bool(terminated[row] | truncated[row])


@pytest.mark.parametrize("mode", MODES)
def test_gymnasiums_statistics_agree_with_ours(make, mode):
    envs = RecordEpisodeStatistics(make(autoreset_mode=mode))
    envs.reset(seed=SEED)
    steps = np.zeros(N, int)
    near_horizon(envs.unwrapped.native, [1, 6], steps_left=12)
    found = []
    for _ in range(13):
        _obs, _reward, terminated, truncated, info = envs.step(FORWARD)
        steps += 1
        for row in np.flatnonzero(terminated | truncated):
            ours = info["final_info"]["episode_return"] if mode == "SameStep" else info["episode_return"]
            found.append((row, info["episode"]["r"][row] - ours[row], int(info["episode"]["l"][row])))
        if mode == "Disabled" and (terminated | truncated).any():
            envs.reset(options={"reset_mask": terminated | truncated})
    assert [(row, length) for row, _difference, length in found] == [(1, 12), (6, 12)]
    assert max(abs(difference) for _row, difference, _length in found) < RETURN_ROUNDING


def test_seeds(make):
    envs = make()
    drawn, _info = envs.reset()
    assert envs.np_random_seed is not None
    other, _info = make().reset()
    assert not np.array_equal(drawn, other), "without a seed the first episodes are random"
    first, info = envs.reset(seed=SEED)
    assert info["seed"].tolist() == [SEED] * N and info["episode_number"].tolist() == list(range(N))
    assert envs.np_random_seed == SEED
    second, info = envs.reset()
    assert info["seed"].tolist() == [SEED] * N and info["episode_number"].tolist() == list(range(N, 2 * N))
    assert not np.array_equal(first, second)
    again, _info = envs.reset(seed=np.int64(SEED))
    np.testing.assert_array_equal(again, first)
    for seed, error in (([1] * N, TypeError), (1.5, TypeError), ("1", TypeError), (-1, ValueError)):
        with pytest.raises(error, match="seed"):
            envs.reset(seed=seed)
    np.testing.assert_array_equal(envs.reset(seed=SEED)[0], first)


@pytest.mark.parametrize("seed", [2**31, 2**32 - 1, np.uint32(4_000_000_000), 3**60, 2**31 - 1])
def test_any_whole_number_is_a_seed(make, seed):
    """Those of 32 bits and more as the page says; the env's own generator takes them as they are."""
    envs, number = make(), int(seed)
    told = hashlib.sha256(number.to_bytes((number.bit_length() + 7) // 8, "big")).hexdigest()
    folded = number if number < 2**31 else int(told[:8], 16) // 2
    first, info = envs.reset(seed=seed)
    assert info["seed"].tolist() == [folded] * N and envs.np_random_seed == number
    np.testing.assert_array_equal(make().reset(seed=folded)[0], first)


def test_envs_do_not_influence_each_other(make):
    envs = make()
    actions = random_actions(40)

    def play(actions):
        envs.reset(seed=SEED)
        near_horizon(envs.native, [5], steps_left=20)
        return np.stack([np.column_stack(envs.step(action)[:4]) for action in actions])

    plain, changed = play(actions), actions.copy()
    changed[:, 3] = -changed[:, 3]
    other = play(changed)
    np.testing.assert_array_equal(np.delete(other, 3, axis=1), np.delete(plain, 3, axis=1))
    assert not np.array_equal(other[:, 3], plain[:, 3])


@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_results_are_memory_of_their_own(make, backend):
    """Nothing that a call gave is changed by a later one; both backends say the same."""
    envs, plain = make(backend=backend), []

    def values(result):
        final = result[-1].get("final_info", {})
        return [*result[:-1], *result[-1].values(), *final.values()]

    results = [envs.reset(seed=SEED)]
    near_horizon(envs.native, [0], steps_left=2)
    for action in random_actions(4):
        results.append(envs.step(torch.from_numpy(action) if backend == "torch" else action))
        plain.append(
            [np.asarray(value).copy() for value in values(results[-1]) if not isinstance(value, dict)]
        )
    kept = [
        [np.asarray(value) for value in values(result) if not isinstance(value, dict)]
        for result in results[1:]
    ]
    for now, then in zip(kept, plain, strict=True):
        for a, b in zip(now, then, strict=True):
            assert a.dtype == b.dtype and (a.dtype == object or np.array_equal(a, b))
    wanted = np.ndarray if backend == "numpy" else torch.Tensor
    assert all(isinstance(value, wanted) for value in values(results[-1]) if not isinstance(value, dict))
    last = np.asarray(results[2][-1]["final_obs"][0])
    assert last.shape == (envs.native.num_obs,) and not np.array_equal(last, np.asarray(results[2][0][0]))


def test_torch_and_numpy_say_the_same(make):
    def play(backend):
        envs = make(backend=backend)
        envs.reset(seed=SEED)
        return [
            np.column_stack([np.asarray(part) for part in envs.step(action)[:4]])
            for action in random_actions(10)
        ]

    for a, b in zip(play("numpy"), play("torch"), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_held_action_is_so_many_steps_in_one(make):
    """Rewards add up; a row that ends on the way rests there."""
    actions = random_actions(5)
    fine = make(autoreset_mode="Disabled")
    fine.reset(seed=SEED)
    rewards, obs = np.zeros((5, N)), []
    for turn, action in enumerate(actions):
        for _ in range(4):
            newest, reward, *_rest = fine.step(action)
            rewards[turn] += reward
        obs.append(newest)
    held = make(hold_steps=4)
    held.reset(seed=SEED)
    for turn, action in enumerate(actions):
        newest, reward, *_rest, info = held.step(action)
        np.testing.assert_array_equal(newest, obs[turn])
        np.testing.assert_allclose(reward, rewards[turn], atol=RETURN_ROUNDING)
    assert (info["episode_steps"] == 20).all()
    near_horizon(held.native, [6], steps_left=2)
    _obs, reward, _terminated, truncated, info = held.step(actions[0])
    assert truncated[6] and info["final_info"]["episode_steps"][6] == held.native.config.episode.horizon_steps
    assert info["episode_steps"][6] == 0
    assert np.isfinite(reward).all()


def test_close_twice_and_use_outside_the_life(make):
    envs = make()
    envs.reset(seed=SEED)
    envs.close()
    envs.close()
    assert envs.closed
    for use in (lambda: envs.step(FORWARD), lambda: envs.reset(seed=1)):
        with pytest.raises(RuntimeError, match="is closed"):
            use()


@pytest.mark.parametrize(
    ("use", "error", "words"),
    [
        (lambda e: e.step(FORWARD[:3]), ValueError, r"shape \(8, 4\)"),
        (lambda e: e.step(FORWARD * np.nan), ValueError, "not finite in env 0"),
        (lambda e: e.step(["a"] * N), ValueError, "str"),
        (lambda e: e.reset(options={"goal": 1}), ValueError, "'goal'.*do not exist; there is 'reset_mask'"),
        (lambda e: e.reset(options={"reset_mask": np.ones(N)}), TypeError, "must be bool"),
        (lambda e: e.reset(options={"reset_mask": np.zeros(N, bool)}), ValueError, "true somewhere"),
        (lambda e: e.reset(options={"reset_mask": np.ones(3, bool)}), ValueError, r"shape \(8,\)"),
        (lambda e: UuvVectorEnv(sim=e.native.sim, backend="jax"), ValueError, "numpy, torch"),
        (lambda e: UuvVectorEnv(sim=e.native.sim, hold_steps=0), ValueError, "at least 1 control step"),
        (lambda e: UuvVectorEnv(sim=e.native.sim, autoreset_mode="never"), ValueError, "never"),
        (lambda e: UuvVectorEnv("ocean"), ConfigError, "there are: .*pool"),
        (lambda e: UuvVectorEnv(num_envs=2.5), TypeError, "num_envs must be an int"),
        (lambda e: UuvEnv(render_mode="human"), ValueError, "'rgb_array'"),
    ],
)
def test_what_does_not_fit_is_refused_and_loses_nothing(make, use, error, words):
    envs = make()
    envs.reset(seed=SEED)
    wanted = envs.step(FORWARD)[0]
    envs.reset(seed=SEED)
    with pytest.raises(error, match=words):
        use(envs)
    np.testing.assert_array_equal(envs.step(FORWARD)[0], wanted)


# ---------------------------------------------------------------------------------------------------- one env


def test_the_single_env_plays_the_first_row(small):
    """Observations, rewards and ends are those of the batch's env 0; an end has to be answered by a reset."""
    env, batch = UuvEnv(sim=small.sim), VectorEnv(small.sim, seed=SEED)
    actions = random_actions(20)
    obs, info = env.reset(seed=SEED)
    answer = [(obs, 0.0)]
    near_horizon(env.native, [0], steps_left=20)
    for action in actions[:, 0]:
        obs, reward, terminated, truncated, info = env.step(action)
        answer.append((obs, reward))
    assert truncated and not terminated and info["outcome"] == "timeout" and not info["is_success"]
    assert obs in env.observation_space
    with pytest.raises(RuntimeError, match=r"end of the episode: call reset\(\)"):
        env.step(actions[0, 0])
    assert env.reset()[1]["episode_number"] == N
    obs, _info = batch.reset()
    np.testing.assert_array_equal(answer[0][0], obs[0])
    near_horizon(env.native, [0], steps_left=20)
    for (wanted, wanted_reward), action in zip(answer[1:], actions, strict=True):
        _obs, reward, *_rest, info = batch.step(torch.from_numpy(action))
        np.testing.assert_array_equal(info["final_obs"][0], wanted)
        assert reward[0] == pytest.approx(wanted_reward, abs=RETURN_ROUNDING)
    for action in (actions[0], actions[0, 0] * np.nan):
        with pytest.raises(ValueError):
            env.reset()
            env.step(action)
    with pytest.raises(ValueError, match="there are none"):
        env.reset(options={"goal": 1})
    env.close()
    env.close()


def test_the_picture_shows_the_tank_in_its_shape(small):
    env = UuvEnv(sim=small.sim, render_mode="rgb_array", hold_steps=5)
    assert env.metadata["render_fps"] == 10 and UuvEnv.metadata["render_fps"] == 50
    env.reset(seed=SEED)
    before = env.render()
    assert before.dtype == np.uint8 and before.shape[1:] == (640, 3)
    tank = small.config.world.tank
    assert before.shape[0] / 640 == pytest.approx(
        (tank.y_m[1] - tank.y_m[0]) / (tank.x_m[1] - tank.x_m[0]), rel=0.15
    )
    for _ in range(10):
        env.step(FORWARD[0])
    changed = (env.render() != before).any(axis=2)
    assert 0 < changed.mean() < 0.5, "the vehicle and what it maps move, the tank does not"
    assert UuvEnv(sim=small.sim).render() is None


def test_without_gymnasium_one_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "uuvtai.envs.gymnasium")
    with pytest.raises(
        ModuleNotFoundError,
        match=r"^uuvtai.envs.gymnasium needs Gymnasium; install it with: pip install 'uuvtai\[gym\]'$",
    ):
        importlib.import_module("uuvtai.envs.gymnasium")


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_gymnasium_finds_the_env_without_an_import_of_ours(make, monkeypatch):
    """A world that does not exist is refused by us, before anything is compiled."""
    monkeypatch.delitem(gymnasium.registry, ENV_ID)
    monkeypatch.setattr(sys.modules["uuvtai.envs"], "gymnasium", single)
    monkeypatch.delitem(sys.modules, single.__name__)
    with pytest.raises(ConfigError, match="did you mean 'pool'"):
        make(f"{single.__name__}:{ENV_ID}", world="pol")
    assert sys.modules[single.__name__] is not single
