"""The trainer learns, goes on bit for bit, and neither spreads nor hides what is not finite."""

import math
from pathlib import Path

import pytest
import torch

from tests.point_env import PointEnv
from uuvtai.config.learning import LearningConfig
from uuvtai.learning.checkpoint import pack
from uuvtai.learning.environments import Simulated
from uuvtai.learning.networks import OBSERVATION, Guard, TrainingError
from uuvtai.learning.trainer import Trainer

ROOT = Path(__file__).parents[2]
WALL_TIMES = tuple(
    f"time/{n}" for n in ("simulate_s", "infer_s", "learn_s", "env_steps_per_s", "decisions_per_s")
)
SUMMED_APART = 1e-4
"""float32 gradients of one minibatch added up in another order, over two iterations of a few Adam steps
each"""


def config_of(**sections):
    """A small run: 16 steps, narrow networks, the world model on."""
    small = {
        "policy": {"hidden": [16, 16], "hold_steps": 1},
        "ppo": {"rollout_steps": 16, "epochs": 2, "minibatches": 2, "learning_rate": 1e-3},
        "distillation": {"batch": 64, "schedule": [[0, 1], [1, 0.2]]},
        "world_model": {"hidden": [16], "latent": 8, "batch": 64},
        "train": {"iterations": 8},
    }
    return LearningConfig.model_validate(
        {name: small.get(name, {}) | sections.get(name, {}) for name in {**small, **sections}}
    )


def same(a, b):
    """Equal to the last bit, NaN included."""
    (plain_a, tensors_a), (plain_b, tensors_b) = pack(a), pack(b)
    assert plain_a == plain_b
    for name, tensor in tensors_a.items():
        assert torch.equal(
            tensor.view(torch.uint8) if tensor.dim() else tensor,
            tensors_b[name].view(torch.uint8) if tensor.dim() else tensors_b[name],
        ), name


def trainer_of(env, config):
    """A trainer in an env with ``VectorEnv``'s interface."""
    return Trainer(Simulated(env, config), config)


def comparable(metrics):
    """All metrics but wall times."""
    return {name: value for name, value in metrics.items() if name not in WALL_TIMES}


def test_it_learns_the_task_from_its_teacher_and_says_so():
    teaching = {"batch": 64, "steps": 16, "learning_rate": 3e-3, "schedule": [[0, 1], [1, 0.2]]}
    trainer = trainer_of(PointEnv(), config_of(train={"iterations": 12}, distillation=teaching))
    first = trainer.iterate()
    for _ in range(11):
        last = trainer.iterate()
    assert last["distillation/loss"] < 0.5 * first["distillation/loss"]
    assert last["rollout/success_rate"] > 0.9
    assert last["distillation/leaf/Far"] > 0 and last["distillation/leaf/Near"] > 0
    assert (first["distillation/lambda"], last["distillation/lambda"]) == (
        1.0,
        pytest.approx(1 - 0.8 * 11 / 12),
    )
    assert last["distillation/lambda_risk"] == pytest.approx(
        last["distillation/lambda"] * last["distillation/scale"]
    )
    assert last["time/env_steps"] == 16 * 16 * 13, "the rollout that the tree drove counts too"
    assert last["reward/progress"] > first["reward/progress"]
    assert set(WALL_TIMES) < set(last)


@pytest.mark.parametrize("more", [{}, {"ppo": {"target_kl": 0.01, "rollout_steps": 16}}])
def test_four_iterations_equal_two_and_two_more_after_a_resume(more):
    config = config_of(**more)
    whole = trainer_of(PointEnv(), config)
    metrics = [comparable(whole.iterate()) for _ in range(4)]
    first = trainer_of(PointEnv(), config)
    assert [comparable(first.iterate()) for _ in range(2)] == metrics[:2]
    state = first.state()
    first.iterate()
    second = trainer_of(PointEnv(seed=9), config)
    second.iterate()
    second.load_state(state)
    assert [comparable(second.iterate()) for _ in range(2)] == metrics[2:]
    same(second.state(), whole.state())


def test_nothing_draws_from_the_global_generator():
    torch.manual_seed(1)
    before = torch.get_rng_state()
    trainer_of(PointEnv(), config_of()).iterate()
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(
    ("poison", "metric"),
    [
        ("obs", "non_finite/position"),
        ("final_obs", None),
        ("reward", "non_finite/reward"),
        ("teacher_action", "non_finite/teacher_action"),
    ],
)
def test_what_is_not_finite_is_told_and_does_not_spread(poison, metric):
    env = PointEnv()
    trainer = trainer_of(env, config_of())
    assert not any(name.startswith("non_finite/") for name in trainer.iterate())
    env.poison = {poison}
    metrics = trainer.iterate()
    if metric:
        assert metrics[metric] > 0
    assert metrics["train/invalid_samples"] >= 15
    assert metrics["train/skipped_updates"] == 0
    state = trainer.state()
    for name in ("policy", "world_model", "uncertainty", "ppo"):
        assert all(bool(t.isfinite().all()) for t in pack(state[name])[1].values()), name
    assert all(math.isfinite(value) for value in metrics.values())
    env.poison = set()
    trainer.iterate()  # its first sample is what the last poisoned step told
    trainer.iterate()
    assert trainer.env.guard.bad_in_a_row == 0


def test_bad_iterations_in_a_row_are_an_error_that_names_them():
    env = PointEnv(seed=4)
    trainer = trainer_of(env, config_of(train={"patience": 3, "seed": 4}))
    trainer.iterate()
    env.poison = {"reward"}
    trainer.iterate()
    trainer.iterate()
    with pytest.raises(
        TrainingError, match=r"iterations 2 to 4 .* reward .* env 1 \(seed 4, episode \d+\).*learning_rate"
    ):
        trainer.iterate()


def test_a_gradient_that_is_not_finite_changes_nothing_and_is_told():
    trainer = trainer_of(
        PointEnv(), config_of(distillation={"schedule": [[0, 0]]}, world_model={"enabled": False})
    )
    trainer.iterate()
    trainer.policy.actor[0].weight.register_hook(lambda gradient: gradient * math.nan)
    before = [p.clone() for p in trainer.policy.actor.parameters()]
    assert trainer.iterate()["train/skipped_updates"] == 4
    assert all(torch.equal(a, b) for a, b in zip(before, trainer.policy.actor.parameters(), strict=True))
    assert trainer.env.guard.bad_in_a_row == 1


def test_a_policy_whose_actions_are_not_finite_ends_the_training():
    trainer = trainer_of(PointEnv(), config_of(distillation={"schedule": [[0, 0]]}))
    trainer.iterate()
    with torch.no_grad():
        trainer.policy.actor[0].weight.fill_(math.nan)
    with pytest.raises(TrainingError, match=r"smaller ppo\.learning_rate"):
        trainer.iterate()


def test_the_world_models_columns_can_be_left_out():
    trainer = trainer_of(PointEnv(), config_of(world_model={"as_features": False}))
    trainer.iterate()
    assert not trainer.rollout["x"][..., -2:].any()
    assert (trainer.rollout["uncertainty"] > 0).all(), "the distillation is scaled all the same"
    shown = trainer_of(PointEnv(), config_of())
    shown.iterate()
    assert shown.rollout["x"][1:, :, -2:].any()


def test_first_inputs_of_an_episode_have_no_prediction_behind_them():
    trainer = trainer_of(PointEnv(), config_of())
    trainer.iterate()
    ended, x = trainer.rollout["ended"][:-1], trainer.rollout["x"][1:]
    assert ended.any()
    assert not x[ended][:, -2:].any() and (x[~ended][:, -1] > 0).all()


@pytest.mark.parametrize("name", [OBSERVATION, "reward"])
def test_large_numbers_whose_sum_is_infinite_are_sound(name):
    guard = Guard([("range", slice(0, 3))], 2, 3, torch.device("cpu"))
    large = torch.tensor([[3e38, 3e38, 1.0], [0.0, 2.0, -4.0]])
    out, bad = guard.values(name, large)
    assert bad.tolist() == [False, False] and torch.equal(out, large) and guard.take() == {}


def test_the_guard_fills_in_and_counts_what_is_not_finite():
    guard = Guard([("range", slice(0, 2))], 2, 3, torch.device("cpu"))
    out, bad = guard.values(OBSERVATION, torch.tensor([[1.0, math.inf], [2.0, 3.0]]), torch.full((2,), 7.0))
    assert bad.tolist() == [True, False] and out.tolist() == [[1.0, 7.0], [2.0, 3.0]]
    assert not guard.values(OBSERVATION, torch.ones(2, 2))[1].any(), "bad once is not bad ever after"
    assert guard.take() == {"non_finite/range": 1.0}
