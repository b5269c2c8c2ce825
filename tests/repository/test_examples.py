"""The examples: every script runs on the session's simulator and gives what it promises."""

import importlib
import re
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import uuvtai
from tests.conftest import configure
from uuvtai.compile.runtime import start_taichi
from uuvtai.config.loader import load_config
from uuvtai.envs.gymnasium import UuvVectorEnv
from uuvtai.envs.vector_env import VectorEnv
from uuvtai.evaluation.agents import load_agents
from uuvtai.evaluation.episodes import jobs_of, run_episodes
from uuvtai.plugins.api import plugin_spec
from uuvtai.plugins.loading import load_plugin, obstacles_of
from uuvtai.report.world import check

EXAMPLES = Path(__file__).parents[2] / "examples"
N = 8
MOST_LINES = {"train": 100, "custom": 60, "own": 30}
"""a newcomer reads an example in one go"""
SHORT = 60
"""[control steps] of an episode here"""
TRAINERS = {
    "train_sb3": "stable_baselines3",
    "train_skrl": "skrl",
    "train_torchrl": "torchrl",
    "train_rsl_rl": "rsl_rl",
}


@pytest.fixture
def example(monkeypatch):
    """Module of an example, as ``python examples/NAME.py`` would find what it imports."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module


@pytest.fixture
def short(small, monkeypatch):
    """The session's simulator with every episode begun shortly before its horizon."""
    small.sim.use_tree(small.trees["bt"])
    small.begin_late(monkeypatch, SHORT)
    yield small.sim
    small.sim.use_tree(small.trees["bt"])


@pytest.mark.parametrize("name", TRAINERS)
def test_a_trainer_learns_and_what_it_learnt_is_played_again(
    short, example, monkeypatch, tmp_path, capsys, name
):
    """The policy that is read back acts as the one that was saved; and the command line does both."""
    pytest.importorskip(TRAINERS[name], reason=f"{TRAINERS[name]} is not installed")
    module, judge = example(name), example("judge")
    if name == "train_rsl_rl":
        monkeypatch.setitem(module.CONFIG, "num_steps_per_env", 8)
    else:
        monkeypatch.setattr(module, "ROLLOUT_STEPS", 8)
    obs, _info = UuvVectorEnv(sim=short).reset(seed=1)
    (tmp_path / "saved").mkdir()
    trained = module.train(short, 2, tmp_path / "saved")(obs)
    np.testing.assert_allclose(module.play(short, tmp_path / "saved")(obs), trained, rtol=1e-5, atol=1e-6)
    before, again = (module.train(short, 0)(obs) for _ in range(2))
    np.testing.assert_array_equal(before, again)
    assert trained.shape == (N, 4) and np.isfinite(trained).all() and not np.allclose(before, trained)
    out = tmp_path / "new" / "run"
    judge.main(
        module.train, module.play, 1, ["--out", str(out), "--curve", str(tmp_path / "curve.csv")], short
    )
    before, saved, played = capsys.readouterr().out.splitlines()
    assert before.startswith("before return") and saved.endswith(f"saved in {out}")
    assert played.startswith("played return") and f"/{N} (" in played
    assert any(out.iterdir()) and (tmp_path / "curve.csv").read_text().startswith("decisions,return")
    judge.main(module.train, module.play, 1, ["--play", str(out)], short)
    assert capsys.readouterr().out.splitlines() == [played]
    with pytest.raises(SystemExit):
        judge.main(module.train, module.play, 1, ["--out", str(out)], short)
    assert "is there already; give a new folder" in capsys.readouterr().err


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_a_watched_batch_keeps_every_return_once(short, example, mode):
    """They are what the simulator itself summed up over the episode."""
    envs = example("judge").Watched(sim=short, hold_steps=5, autoreset_mode=mode)
    envs.reset(seed=1)
    answer = []
    for decision in range(1, 2 + SHORT // 5):
        *_, terminated, truncated, info = envs.step(np.zeros((N, 4), np.float32))
        ended = info["final_info"] if mode == "SameStep" and "final_info" in info else info
        answer += [
            (decision * N, float(ended["episode_return"][env]))
            for env in np.flatnonzero(terminated | truncated)
        ]
    assert len(answer) >= N
    np.testing.assert_allclose(envs.curve, answer, rtol=1e-4, atol=1e-4)


def test_curves_are_drawn_from_what_was_kept(example, tmp_path):
    (tmp_path / "a.csv").write_text("decisions,return\n" + "".join(f"{64 * i},{i}\n" for i in range(1, 300)))
    example("judge").draw([tmp_path / "a.csv"], tmp_path / "out.png")
    assert cv2.imread(str(tmp_path / "out.png")).std() > 5


def test_judge_plays_each_env_once(short, example):
    """The return is that of the first episode, though other envs go on for longer."""
    judge = example("judge")
    seen = []

    def act(obs):
        seen.append(len(obs))
        return np.zeros((N, 4), np.float32)

    returns, won = judge.judge(short, act, seed=5)
    assert won == 0 and seen == [N] * (SHORT // judge.HOLD_STEPS)
    native = VectorEnv(short, seed=5)
    native.reset()
    for _ in range(SHORT):
        *_rest, info = native.step(torch.zeros(N, 4))
    np.testing.assert_allclose(returns, info["episode_return"], atol=1e-3)


def test_custom_controller_prints_a_table(short, example):
    head, *rows = example("custom_controller").main(short).splitlines()
    assert head.split() == ["controller", "success", "return"]
    assert [row.split()[0] for row in rows] == ["careful", "blind"] and all(f"/{N}" in row for row in rows)


def test_custom_controller_turns_and_stops(small, example):
    module = example("custom_controller")
    columns, obs = VectorEnv(small.sim).columns, np.zeros((3, VectorEnv(small.sim).num_obs), np.float32)
    obs[:, columns["sector_range"]] = 12.0
    obs[:, columns["heading_error"]] = [[0, 1], [1, 0], [0, 1]]
    obs[2, columns["sector_range"].start] = 0.4
    action = module.careful(obs, columns)
    assert action[0, 0] == 1 and action[0, 3] == 0, "free and straight ahead: full speed"
    assert action[1, 0] == pytest.approx(0, abs=1e-6) and action[1, 3] == 1, (
        "to the left: turn left on the spot"
    )
    assert action[2, 0] < 0, "too near: back"


def test_custom_world_is_played_and_drawn(short, example, tmp_path):
    answer = example("custom_world").main(tmp_path / "new" / "harbour.png", short)
    assert answer.startswith("harbour.yaml: timeout") and answer.endswith("harbour.png")
    assert cv2.imread(str(tmp_path / "new" / "harbour.png")).std() > 1


def test_episodes_can_begin_in_the_custom_world():
    told, problem, _label = check(load_config(str(EXAMPLES / "harbour.yaml")))
    assert not problem and not [line for line in told if line.startswith("look at it")]


def test_custom_vehicle_follows_its_command(taichi_runtime, example, monkeypatch):
    """The one beside it: ``tests/evaluation/test_simulate.py``."""
    monkeypatch.setattr(uuvtai, "simulate", partial(uuvtai.simulate, runtime=start_taichi("cpu")))
    module = example("custom_vehicle")
    theirs, ours = (load_config("open", vehicle=name).vehicle for name in module.VEHICLES)
    assert ours.mass_kg > theirs.mass_kg and len(ours.thrusters) == len(theirs.thrusters)
    monkeypatch.setattr(module, "VEHICLES", module.VEHICLES[1:])
    head, row = module.main().splitlines()
    name, *speeds = row.split()
    assert head.split()[-2:] == ["4.0", "s"] and name == "heavy_pack"
    assert abs(float(speeds[-1]) - 0.6) < 0.02 and float(speeds[0]) < 0.4


def test_custom_reward_changes_the_terms_it_names(small, example, monkeypatch):
    module = example("custom_reward")
    names = VectorEnv(small.sim).reward_terms
    default = module.terms(VectorEnv(small.sim), 30)
    weights = {key.removeprefix("reward."): value for key, value in module.CAREFUL.items()}
    changed = small.config.reward.model_copy(update=weights)
    configure(monkeypatch, small.sim, small.config.model_copy(update={"reward": changed}))
    careful = module.terms(VectorEnv(small.sim), 30)
    for i, name in enumerate(names):
        was, now = getattr(small.config.reward, name), getattr(changed, name)
        assert was * float(careful[i]) == pytest.approx(now * float(default[i]), rel=1e-4, abs=1e-6 * was)
        assert (was != now) == (name in weights)
    rows = module.table({"default": default, "careful": careful}, names).splitlines()
    assert len(rows) == len(names) + 2
    assert float(rows[-1].split()[1]) == pytest.approx(float(default.sum()), abs=0.01)


def test_custom_tree_stands_beside_the_shipped_ones(example, monkeypatch):
    asked = []
    monkeypatch.setattr(uuvtai, "evaluate", lambda *given, **words: asked.append((given, words)) or "a table")
    assert example("custom_tree").main(seeds=3) == "a table"
    (((trees, world), words),) = asked
    assert [agent.name for agent in load_agents(list(map(str, trees)))] == ["patient", "bt", "planner"]
    assert world == "pool" and words == {"episodes": 128, "seeds": 3}


def test_examples_import_nothing_deeper_than_the_package():
    for path in (*EXAMPLES.glob("*.py"), EXAMPLES / "tutorial.ipynb"):
        assert not re.search(r"(from|import) uuvtai\.", path.read_text()), path.name
    assert all(hasattr(uuvtai, name) for name in dir(uuvtai)) and "Sb3VecEnv" in dir(uuvtai)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*_*.py")), ids=lambda path: path.stem)
def test_an_example_is_short_and_says_what_it_does(path):
    lines = path.read_text().splitlines()
    assert len(lines) <= MOST_LINES[path.stem.partition("_")[0]]
    assert lines[0].startswith('"""') and f"examples/{path.name}" in path.read_text()


OWN = {"own_astar.py": "planner", "own_field.py:act": "controller", "own_torch.py:Pilot": "controller"}


@pytest.mark.parametrize("name", OWN)
def test_an_own_piece_drives(short, name):
    """It runs its episodes without an error, and gets nearer to the goal."""
    agent = load_agents([f"{OWN[name]}:{EXAMPLES / name}"])[0]
    observed, short.planner = short.observation, agent.planner_for(short)
    try:
        note = agent.agent_for(short)
        results, _steps = run_episodes(short, jobs_of([77], N), agent=note.agent if note else None)
    finally:
        short.planner, short.observation = None, observed
        agent.own.close()
    assert [r.outcome for r in results] == ["timeout"] * N and max(r.path_length_m for r in results) > 0.1
    assert (sum(r.planned_by["own"] for r in results) >= N) == (OWN[name] == "planner")


def test_own_reward_pays_for_distance_and_calm(short, monkeypatch):
    monkeypatch.chdir(EXAMPLES.parent)
    env = VectorEnv(short)
    load_plugin(plugin_spec("examples/own_reward.py:Careful", "reward")).reward(env)
    assert env.reward_terms[-2:] == ("near", "jerk")
    env.reset()
    for push in (0.0, 0.5, 0.5):
        *_rest, info = env.step(torch.full((N, 4), push))
    assert (info["reward_terms"][:, -2:] <= 0).all() and info["reward_terms"][:, -1].tolist() == [0.0] * N
    np.testing.assert_allclose(info["episode_terms"][:, -1], -0.02, atol=1e-6)


def test_own_motion_keeps_within_the_pool():
    paths = obstacles_of(plugin_spec(str(EXAMPLES / "own_motion.py"), "motion"))
    fixed = load_config("pool", overrides=[("world.added", paths)]).world.fixed
    assert [len(one.path) for one in fixed] == [48, 2]


def test_own_astar_goes_around_what_is_in_the_way(example):
    """Through the one opening of a wall, by its middle; and out of cells that are too near to it."""
    clearance = np.full((40, 60), 2.0, np.float32)
    rows = np.abs(np.arange(40) - 9.5)[:, None] * 0.1
    clearance[:, 25:35] = np.where(rows < 0.9, 1.0 - rows, 0.0)
    clearance[[0, -1]] = clearance[:, [0, -1]] = 0.0
    plan = example("own_astar").plan
    start, goal = np.array([1.05, 2.05]), np.array([5.05, 2.05])
    way = plan(clearance, 0.1, start, goal, None)
    inside = way[(way[:, 0] > 2.5) & (way[:, 0] < 3.5)]
    np.testing.assert_allclose([way[0], way[-1]], [start, goal], atol=1e-9)
    assert len(way) < 15 and len(inside) and np.abs(inside[:, 1] - 1.0).max() < 0.3
    clearance[:, 25:35] = 0.0
    assert plan(clearance, 0.1, start, goal, None) is None


@pytest.mark.parametrize("name", TRAINERS)
def test_what_a_trainer_saved_drives_as_an_own_policy(short, example, tmp_path, name):
    """``uuv eval --agent examples/own_NAME.py:load=FOLDER`` does what the trainer's own policy does."""
    pytest.importorskip(TRAINERS[name], reason=f"{TRAINERS[name]} is not installed")
    example(name).train(short, 0, tmp_path)
    spec = f"policy:{EXAMPLES / name.replace('train', 'own')}.py:load={tmp_path}"
    obs, _info = UuvVectorEnv(sim=short).reset(seed=1)
    with torch.no_grad():
        expected = example(name).play(short, tmp_path)(obs)
    obs, _info = UuvVectorEnv(sim=short).reset(seed=1)
    agent = load_agents([spec])[0].agent_for(short).agent
    found = agent.decide(torch.from_numpy(obs)).action.numpy()
    np.testing.assert_allclose(found, np.clip(expected, -1, 1), rtol=1e-4, atol=1e-5)
    assert agent.code.marks.hold_steps == example("judge").HOLD_STEPS
