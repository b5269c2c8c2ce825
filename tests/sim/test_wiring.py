"""What the trainer learns from, by hand on a scripted environment: losses, samples, labels."""

import copy

import pytest
import torch

from tests.learning.test_train import config_of
from tests.scripted_env import N_TARGET, ScriptedEnv
from uuvtai.learning.environments import Simulated
from uuvtai.learning.trainer import Trainer

STEPS, ITERATIONS = 16, 8
LAMBDA = [1.0, 0.9]
"""of the first two iterations: from 1 at share 0 to 0.2 at share 1"""
FLOAT32 = 2e-5
"""relative to the largest number: sums over a hundred samples in another order"""
SCRIPT = [
    [(20, "collision"), (7, "timeout"), (12, "collision")],
    [(4, "success"), (13, "timeout"), (9, "ttc"), (10, "timeout")],
    [(22, "timeout"), (22, "success")],
    [(25, "success"), (23, "timeout")],
    [],
]
"""of five envs; the tree's rollout are steps 1 to 16, the policy's first 17 to 32, its second 33 to 48"""


def watch_gradients(ppo):
    """A dict that has the gradients of its newest step by parameter, before their norm is cut."""
    seen, step = {}, ppo.step

    def watched(**options):
        seen.update({name: p.grad.clone() for name, p in ppo.policy.named_parameters()})
        return step(**options)

    ppo.step = watched
    return seen


def trainer_of(script=SCRIPT, **sections):
    """(trainer, env): one epoch, one minibatch, no teacher batches; the running uncertainty is the newest."""
    own = {
        "ppo": {
            "rollout_steps": STEPS, "epochs": 1, "minibatches": 1, "normalise_values": False,
            "entropy_weight": 0.01,
        },
        "distillation": {"steps": 0, "schedule": [[0, 1], [1, 0.2]]},
        "uncertainty": {"ema": 1.0, "max_scale": 50.0},
        "train": {"iterations": ITERATIONS},
    }  # fmt: skip
    env = ScriptedEnv(script)
    config = config_of(**{name: own.get(name, {}) | sections.get(name, {}) for name in {**own, **sections}})
    trainer = Trainer(Simulated(env, config), config)
    trainer.seen = watch_gradients(trainer.ppo)
    with torch.no_grad():  # or the residual and the uncertainty would both be near one
        trainer.world_model.decoder[-1].bias[N_TARGET:] += 1.0
        trainer.policy.critic[-1].weight.mul_(3.0)
    return trainer, env


def joined(moments, name):
    """(T, N, ...) from the moments of a rollout."""
    return torch.stack([getattr(moment, name) for moment in moments])


def close(found, expected):
    return bool((found - expected).abs().max() <= FLOAT32 * expected.abs().max())


def residual_and_uncertainty(model, obs, action, next_obs):
    """Both (T, N) by the paper's equations."""
    with torch.no_grad():
        _, mean, log_var = model.predict(obs, action)
    error = (next_obs[..., :N_TARGET] - mean).clamp(-100.0, 100.0)
    residual = error.square().mean(-1).sqrt()
    return residual, log_var.exp().mean(-1)


# --------------------------------------------------------------------------- what the actor's loss is made of


def advantages(rollout, gamma=0.99, lam=0.95):
    """Standardised generalised advantages, sample by sample."""
    out = torch.zeros_like(rollout["reward"])
    for env in range(out.shape[1]):
        carried = 0.0
        for t in reversed(range(len(out))):
            ahead = 0.0 if rollout["terminated"][t, env] else gamma * float(rollout["next_value"][t, env])
            delta = float(rollout["reward"][t, env]) + ahead - float(rollout["value"][t, env])
            carried = delta + (0.0 if rollout["ended"][t, env] else gamma * lam * carried)
            out[t, env] = carried
    return (out - out.mean()) / out.std(correction=0)


def gradients(policy, rollout, distilled):
    """Of the actor and of log_std by the textbook; ``distilled`` (T, N) multiplies imitation errors."""
    policy = copy.deepcopy(policy)
    advantage = advantages(rollout)
    mean, log_std = policy.mean_of(policy.prepared(rollout)), policy.log_std
    normal = torch.distributions.Normal(mean, log_std.exp())
    ratio = (normal.log_prob(rollout["action"]).sum(-1) - rollout["log_prob"]).exp()
    surrogate = -torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    imitation = ((mean - rollout["teacher_action"]) ** 2).sum(-1)
    (surrogate - 0.01 * normal.entropy().sum(-1).mean() + (distilled * imitation).mean()).backward()
    return torch.cat([policy.log_std.grad, *(p.grad.flatten() for p in policy.actor.parameters())])


def seen_by_the_optimiser(trainer):
    """The gradients as PPO's optimiser got them in the newest iteration, before their norm is cut."""
    of_actor = (tensor.flatten() for name, tensor in trainer.seen.items() if name.startswith("actor."))
    return torch.cat([trainer.seen["log_std"], *of_actor])


def learned_once(trainer, env):
    """(policy, world model, moments) that the second iteration began with and met."""
    trainer.iterate()
    before = copy.deepcopy(trainer.policy), copy.deepcopy(trainer.world_model)
    trainer.iterate()
    return *before, env.log[-STEPS:]


@pytest.mark.parametrize("gain", [0.0, 0.8])
def test_the_distillation_is_weighed_by_lambda_times_the_scale_of_the_uncertainty(gain):
    """The whole loss's gradient; by lambda alone, without, or by the residual it is another."""
    trainer, env = trainer_of(uncertainty={"ema": 1.0, "gain": gain, "max_scale": 50.0})
    policy, model, moments = learned_once(trainer, env)
    residual, sigma = residual_and_uncertainty(
        model, *(joined(moments, name) for name in ("obs", "action", "final_obs"))
    )
    ones, found = torch.ones_like(sigma), seen_by_the_optimiser(trainer)
    strength = LAMBDA[1] * (1.0 + gain * float(sigma.mean()))
    assert close(found, gradients(policy, trainer.rollout, strength * ones))
    for wrong in {0.0, LAMBDA[0], LAMBDA[1], LAMBDA[1] * (1.0 + gain * float(residual.mean()))} - {strength}:
        assert not close(found, gradients(policy, trainer.rollout, wrong * ones)), wrong


def test_the_scale_is_capped_and_follows_the_running_mean():
    trainer, env = trainer_of(uncertainty={"ema": 0.25, "gain": 0.8, "max_scale": 50.0})
    _, sigma = (t.mean() for t in first_features(trainer, env))
    first, (policy, model, moments) = float(sigma), learned_once(trainer, env)
    _, sigma = residual_and_uncertainty(
        model, *(joined(moments, name) for name in ("obs", "action", "final_obs"))
    )
    strength = LAMBDA[1] * (1.0 + 0.8 * (0.75 * first + 0.25 * float(sigma.mean())))
    assert close(
        seen_by_the_optimiser(trainer), gradients(policy, trainer.rollout, torch.full_like(sigma, strength))
    )
    capped, env = trainer_of(uncertainty={"ema": 1.0, "gain": 0.8, "max_scale": 1.1})
    policy, _, _ = learned_once(capped, env)
    assert close(
        seen_by_the_optimiser(capped),
        gradients(policy, capped.rollout, torch.full_like(sigma, 1.1 * LAMBDA[1])),
    )


def first_features(trainer, env):
    """Residual and uncertainty (T, N) that the first iteration of an equal trainer meets."""
    surrogate, env = trainer_of(uncertainty={"ema": 1.0, "max_scale": 50.0})
    begin, models = surrogate._begin, []

    def note():
        found = begin()
        models.append(copy.deepcopy(surrogate.world_model))
        return found

    surrogate._begin = note
    surrogate.iterate()
    return residual_and_uncertainty(
        models[0], *(joined(env.log[-STEPS:], name) for name in ("obs", "action", "final_obs"))
    )


# ------------------------------------------------------------------------------------------------ the rollout


def test_the_rollout_is_what_happened():
    trainer, env = trainer_of()
    policy, model, moments = learned_once(trainer, env)
    rollout = trainer.rollout
    for name, of_log in (
        ("teacher_action", "behavior"),
        *((n, n) for n in ("action", "reward", "terminated", "ended")),
    ):
        assert torch.equal(rollout[name], joined(moments, of_log)), name
    assert torch.equal(rollout["x"][..., :-2], joined(moments, "obs"))
    assert rollout["ended"].any() and (rollout["ended"] & ~rollout["terminated"]).any()
    features = torch.stack(
        residual_and_uncertainty(model, *(joined(moments, name) for name in ("obs", "action", "final_obs"))),
        -1,
    )
    led_to = torch.cat([joined(moments, "final_obs"), features], -1)
    with torch.no_grad():
        expected = policy.expected({"x": led_to}) * ~rollout["terminated"]
    assert torch.allclose(rollout["next_value"], expected, atol=1e-4), (
        "a timeout is bootstrapped from the observation it ended in"
    )
    assert rollout["ended"][-1].any() and expected.std() > 0.01


def test_the_world_models_columns_come_from_the_policys_own_action():
    trainer, env = trainer_of()
    _, model, moments = learned_once(trainer, env)
    obs, action, behavior, final = (
        joined(moments, name) for name in ("obs", "action", "behavior", "final_obs")
    )
    found, on = trainer.rollout["x"][1:, :, -2:], ~trainer.rollout["ended"][:-1]

    def columns(by):
        return torch.stack(residual_and_uncertainty(model, obs, by, final), -1)[:-1]

    assert torch.allclose(found[on], columns(action)[on], rtol=1e-3)
    assert not torch.allclose(found[on], columns(behavior)[on], rtol=1e-3)
    assert not found[~on].any() and (~on).any(), "an episode begins with no prediction behind it"


# -------------------------------------------------------------------------------------------- the world model


def test_the_world_model_learns_from_transitions_that_took_place_and_from_none_across_an_ending():
    trainer, env = trainer_of(world_model={"hidden": [16], "latent": 8, "batch": 400, "steps": 2})
    batches, loss = [], trainer.world_model.loss

    def noted(*batch):
        batches.append(batch)
        return loss(*batch)

    trainer.world_model.loss = noted
    for _ in range(2):
        trainer.iterate()
    happened = {}
    for t, moment in enumerate(env.log):
        last_of_rollout = t % STEPS == STEPS - 1
        for row in range(env.num_envs):
            if not moment.ended[row] and not last_of_rollout:
                happened[float(moment.obs[row, -1])] = tuple(
                    getattr(moment, name)[row] for name in ("obs", "action", "final_obs")
                )
    learned = set()
    for obs, action, next_obs, valid in batches:
        for row in valid.nonzero().flatten().tolist():
            moment = float(obs[row, -1])
            assert moment in happened, "an episode ended here"
            for found, expected in zip((obs, action, next_obs), happened[moment], strict=True):
                assert torch.equal(found[row], expected)
            learned.add(moment)
    assert len(learned) > 0.95 * len(happened), (
        "all that took place is drawn from: the tree's rollout and both of the policy's"
    )


# ----------------------------------------------------------------------------------------------------- rates

ENDS_AT = 7
"""control step of the policy's rollout in which all but one of the envs end"""


def test_rates_count_every_ending_by_what_it_was():
    """Stops for the time to collision and leaving the tank are collisions; what goes on is no episode."""
    endings = ["success"] * 4 + ["timeout"] * 2 + ["collision", "ttc", "out_of_tank", None]
    trainer, _ = trainer_of([[(STEPS + ENDS_AT, how)] if how else [] for how in endings])
    metrics = trainer.iterate()
    rates = [
        metrics[f"rollout/{name}"]
        for name in ("episodes", "success_rate", "collision_rate", "timeout_rate", "ep_len_mean")
    ]
    assert rates == pytest.approx([9, 4 / 9, 3 / 9, 2 / 9, STEPS + ENDS_AT])
