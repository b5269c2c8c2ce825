"""PPO on hand-computed numbers, its guards, its determinism, and a small task that it must learn."""

import math

import pytest
import torch

from uuvtai.config.learning import PolicyConfig, PpoConfig
from uuvtai.learning import ppo as ppo_module
from uuvtai.learning.networks import ActorCritic, log_prob
from uuvtai.learning.ppo import Ppo, adapted_rate, approximate_kl, gae, surrogate_loss
from uuvtai.learning.rollout import Rollout, Step, final_value

FLOAT32 = 1e-5
"""relative and absolute; a few hundred float32 operations on numbers near one"""
T, N, N_IN = 8, 6, 5
DRAWS = torch.Generator()
"""where nothing is drawn"""


def column(*values):
    return torch.tensor(values)[:, None]


# ------------------------------------------------------------------------------------------------- advantages


def test_gae_of_an_episode_that_goes_on():
    """gamma 0.5, lambda 0.5: deltas by hand, then A_t = delta_t + A_{t+1} / 4."""
    no = column(False, False, False)
    reward, value, next_value = column(1.0, 2.0, 3.0), column(2.0, 4.0, 8.0), column(4.0, 8.0, 6.0)
    advantage, returns = gae(reward, value, next_value, no, 0.5, 0.5)
    # deltas: 1 + 2 - 2 = 1; 2 + 4 - 4 = 2; 3 + 3 - 8 = -2
    assert advantage.flatten().tolist() == [1.0 + 0.25 * 1.5, 2.0 - 0.25 * 2.0, -2.0]
    assert returns.flatten().tolist() == [3.375, 5.5, 6.0]


def test_gae_bootstraps_a_timeout_and_not_a_termination():
    reward, value, next_value = column(1.0, 1.0, 1.0), column(2.0, 2.0, 2.0), column(4.0, 4.0, 4.0)
    ended = column(False, True, False)
    cut_off, _ = gae(reward, value, next_value, ended, 0.5, 0.5)
    failed, returns = gae(reward, value, next_value * ~ended, ended, 0.5, 0.5)
    # with bootstrap: delta = 1 + 2 - 2 = 1; without: 1 - 2 = -1; nothing crosses the ending
    assert cut_off.flatten().tolist() == [1.25, 1.0, 1.0]
    assert failed.flatten().tolist() == [0.75, -1.0, 1.0]
    assert returns.flatten().tolist() == [2.75, 1.0, 3.0]


def test_gae_with_several_endings_is_that_of_the_pieces():
    generator = torch.Generator().manual_seed(0)
    reward, value, next_value = (torch.randn(9, 3, generator=generator) for _ in range(3))
    ended = torch.zeros(9, 3, dtype=torch.bool)
    ended[2], ended[6] = True, True
    next_value[6] = 0.0  # a termination
    whole, _ = gae(reward, value, next_value, ended, 0.99, 0.95)
    pieces = [
        gae(reward[a:b], value[a:b], next_value[a:b], ended[a:b], 0.99, 0.95)[0]
        for a, b in ((0, 3), (3, 7), (7, 9))
    ]
    assert torch.equal(whole, torch.cat(pieces))


def test_gae_with_lambda_one_is_the_discounted_return():
    reward, no = column(1.0, 2.0, 4.0), column(False, False, False)
    _, returns = gae(reward, column(9.0, -3.0, 0.5), column(-3.0, 0.5, 8.0), no, 0.5, 1.0)
    assert returns.flatten().tolist() == [1 + 1 + 1 + 1, 2 + 2 + 2, 4 + 4]


# ----------------------------------------------------------------------------------------------------- losses


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss", "slope"),
    [
        (1.0, 2.0, -2.0, -2.0),
        (1.5, 2.0, -2.4, 0.0),
        (0.5, 2.0, -1.0, -1.0),
        (1.5, -2.0, 3.0, 3.0),
        (0.5, -2.0, 1.6, 0.0),
    ],
)
def test_the_surrogate_is_clipped_where_it_would_gain(ratio, advantage, loss, slope):
    log_ratio = torch.tensor([math.log(ratio)], requires_grad=True)
    found = surrogate_loss(log_ratio, torch.tensor([advantage]), 0.2)
    found.sum().backward()
    assert found.item() == pytest.approx(loss, rel=FLOAT32)
    assert log_ratio.grad.item() == pytest.approx(slope, abs=FLOAT32)  # d ratio / d log_ratio = ratio


def test_the_divergence_is_that_of_two_gaussians():
    generator = torch.Generator().manual_seed(0)
    old, new = torch.zeros(4), torch.tensor([0.1, -0.2, 0.0, 0.05])
    log_std, new_log_std = torch.zeros(4), torch.tensor([0.1, 0.0, -0.1, 0.0])
    action = torch.randn(400_000, 4, generator=generator)
    sample = approximate_kl(log_prob(action, new, new_log_std) - log_prob(action, old, log_std))
    pair = torch.distributions.Normal(old, log_std.exp()), torch.distributions.Normal(new, new_log_std.exp())
    assert float(sample.min()) >= 0
    assert float(sample.mean()) == pytest.approx(
        float(torch.distributions.kl_divergence(*pair).sum()), rel=0.01
    )


def test_the_rate_follows_the_divergence():
    rate = torch.tensor(3e-4)
    found = [float(adapted_rate(rate, torch.tensor(kl), 0.01)) for kl in (0.021, 0.015, 0.004)]
    assert found == pytest.approx([2e-4, 3e-4, 4.5e-4])
    assert float(adapted_rate(torch.tensor(1e-5), torch.tensor(1.0), 0.01)) == pytest.approx(1e-5)
    assert float(adapted_rate(torch.tensor(2e-3), torch.tensor(0.0), 0.01)) == pytest.approx(2e-3)


# ---------------------------------------------------------------------------------------------------- rollout


def make_policy(seed=0, **config):
    return ActorCritic(N_IN, PolicyConfig(hidden=(16, 16), **config), torch.Generator().manual_seed(seed))


def make_ppo(seed=0, **config):
    return Ppo(make_policy(seed), PpoConfig(**{"rollout_steps": T, "epochs": 2, "minibatches": 4, **config}))


def add(rollout, t, policy, x, step, came):
    """A step of ``came``: reward, terminated, ended, input that it led to."""
    end = Step(*came[:3], {"x": came[3]}, {})
    view = {"x": x, "teacher_action": torch.zeros_like(step.action)}
    told = {"reward": came[0], "terminated": came[1], "ended": came[2]}
    rollout.note(t, view | step._asdict() | told | {"next_value": final_value(policy, end)})


def fill(rollout, policy, seed=0):
    """Random inputs and rewards, actions of the policy, an ending now and then."""
    generator = torch.Generator().manual_seed(seed)
    for t in range(rollout.steps):
        x = torch.randn(N, N_IN, generator=generator) * 2 + 1
        ended = torch.rand(N, generator=generator) < 0.2
        terminated = ended & (torch.rand(N, generator=generator) < 0.5)
        step = policy.act({"x": x}, generator)
        reward = -step.action.square().sum(-1) + x[:, 0]
        add(rollout, t, policy, x, step, (reward, terminated, ended, x + 1))
    rollout.close(policy.expected({"x": torch.randn(N, N_IN, generator=generator)}))
    return rollout


def gae_of(rollout):
    names = "reward", "value", "next_value", "ended"
    return gae(*(rollout[name] for name in names), 0.99, 0.95)


def mean_of(policy, x):
    return policy.mean_of(policy.prepared({"x": x}))


def weights(policy):
    return torch.cat([p.detach().flatten() for p in policy.parameters()])


def test_next_values_are_those_of_the_true_next_observation():
    policy, rollout = make_policy(), Rollout(2)

    def value_of(x):
        return policy.expected({"x": x})

    x = torch.randn(4, 3, N_IN, generator=torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(1)
    ended = torch.tensor([False, True, True])
    terminated = torch.tensor([False, False, True])
    for t in range(2):
        final = final_value(policy, Step(torch.zeros(3), terminated, ended, {"x": x[3]}, {}))
        assert final.tolist() == pytest.approx([0.0, value_of(x[3])[1].item(), 0.0], abs=FLOAT32)
        step = policy.act({"x": x[t]}, generator)
        add(rollout, t, policy, x[t], step, (torch.zeros(3), terminated, ended, x[3]))
    rollout.close(value_of(x[2]))
    expected = [
        value_of(x[1])[0], value_of(x[3])[1], 0.0, value_of(x[2])[0], value_of(x[3])[1], 0.0,
    ]  # fmt: skip
    assert rollout.flat()["next_value"].tolist() == pytest.approx([float(v) for v in expected], abs=FLOAT32)


# ----------------------------------------------------------------------------------------------------- update


@pytest.mark.parametrize("minibatches", [1, 4, 5, T * N])
@pytest.mark.parametrize("shuffle", [False, True])
def test_minibatches_cover_every_sample_once(minibatches, shuffle):
    ppo = make_ppo(minibatches=minibatches)
    ppo.policy.is_shuffled = shuffle
    rollout = fill(Rollout(T), ppo.policy)
    rollout["log_prob"].copy_(torch.arange(T * N).view(T, N))
    batch, _ = ppo._prepared(rollout)
    index = list(ppo._minibatches(T * N, torch.Generator().manual_seed(0)))
    together = torch.cat([batch["log_prob"][part] for part in index])
    assert len(index) == minibatches
    assert sorted(together.tolist()) == list(range(T * N))
    assert torch.equal(together, batch["log_prob"]) != shuffle


def test_the_update_takes_the_step_of_the_losses_written_out(monkeypatch):
    """One minibatch in passes of 7 rows against the textbook formulas on the whole, and torch's Adam."""
    monkeypatch.setattr(ppo_module, "CACHE_ROWS", 7)
    ppo = make_ppo(epochs=1, minibatches=1, entropy_weight=0.01, normalise_values=False)
    reference = make_policy()
    rollout = fill(Rollout(T), ppo.policy)
    rollout["teacher_action"].normal_(generator=torch.Generator().manual_seed(1))
    metrics = ppo.update(rollout, DRAWS, strength=0.3)

    advantage, target = gae_of(rollout)
    advantage = ((advantage - advantage.mean()) / advantage.std(correction=0)).flatten()
    x = rollout.flat()["x"]
    optimiser = torch.optim.Adam(reference.parameters(), lr=3e-4, eps=ppo_module.ADAM_EPS)
    inputs = reference.prepared({"x": x})
    mean, log_std = reference.mean_of(inputs), reference.log_std
    ratio = (
        torch.distributions.Normal(mean, log_std.exp()).log_prob(rollout.flat()["action"]).sum(-1)
        - rollout.flat()["log_prob"]
    ).exp()
    policy_loss = -torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    value = reference.value_norm.inverse(reference.value_of(inputs))
    value_error = (value - target.flatten()).square().mean()
    distill = (mean - rollout.flat()["teacher_action"]).square().sum(-1).mean()
    spread = torch.distributions.Normal(mean, log_std.exp()).entropy().sum(-1).mean()
    (policy_loss + 1.5 * value_error - 0.01 * spread + 0.3 * distill).backward()
    torch.nn.utils.clip_grad_norm_(reference.parameters(), 1.0)
    optimiser.step()
    # where a gradient is near zero, Adam's first step of 3e-4 has the sign of its rounding; a thousandth of
    # it bounds the rest
    assert torch.allclose(weights(ppo.policy), weights(reference), atol=3e-7)
    assert metrics["train/policy_loss"] == pytest.approx(policy_loss.item(), abs=FLOAT32)
    assert metrics["train/value_loss"] == pytest.approx(value_error.item(), rel=FLOAT32)
    assert metrics["train/distill_loss"] == pytest.approx(distill.item(), rel=FLOAT32)
    # the ratio of the first minibatch is one
    assert metrics["train/approx_kl"] == pytest.approx(0.0, abs=FLOAT32)
    assert metrics["train/clip_fraction"] == 0.0


def test_metrics_have_their_names_and_statistics_follow_the_rollout():
    ppo = make_ppo()
    rollout = fill(Rollout(T), ppo.policy)
    metrics = ppo.update(rollout, DRAWS)
    assert set(metrics) == {
        "train/policy_loss", "train/value_loss", "train/entropy", "train/approx_kl", "train/clip_fraction",
        "train/explained_variance",
        "train/learning_rate", "train/std", "train/skipped_updates", "train/invalid_samples",
        "train/distill_loss",
    }  # fmt: skip
    assert all(math.isfinite(value) for value in metrics.values())
    assert float(ppo.policy.observation_norm.count) == T * N
    assert float(ppo.policy.value_norm.count) == T * N
    assert torch.allclose(ppo.policy.observation_norm.mean.float(), rollout.flat()["x"].mean(0), rtol=FLOAT32)


def test_values_keep_their_meaning_while_their_statistics_move():
    """Pop-Art: an update that hardly steps leaves every value, however far off the returns are."""
    ppo = make_ppo(learning_rate=1e-12, epochs=1, minibatches=1, normalise_observations=False)
    rollout = fill(Rollout(T), ppo.policy)
    for reward in (0.0, 50.0):
        rollout["reward"] += reward
        value, mean = ppo.policy.expected({"x": rollout["x"]}).detach(), float(ppo.policy.value_norm.mean)
        ppo.update(rollout, DRAWS)
        assert abs(float(ppo.policy.value_norm.mean) - mean) > 0.5
        assert torch.allclose(ppo.policy.expected({"x": rollout["x"]}), value, atol=1e-3)


def test_switches_of_the_normalisers():
    ppo = make_ppo(normalise_observations=False, normalise_values=False)
    ppo.update(fill(Rollout(T), ppo.policy), DRAWS)
    assert float(ppo.policy.observation_norm.count) == 0
    assert float(ppo.policy.value_norm.count) == 0


def test_distillation_draws_the_mean_to_the_teacher():
    ppo = make_ppo(epochs=20, learning_rate=3e-3, max_grad_norm=100.0)
    rollout = fill(Rollout(T), ppo.policy)
    rollout["teacher_action"].fill_(0.5)
    x = rollout["x"].clone()
    for _ in range(4):
        ppo.update(rollout, DRAWS, strength=1e3)
    error = (mean_of(ppo.policy, x) - 0.5).detach().abs().mean()
    assert float(error) < 0.05
    before = (mean_of(make_policy(), x) - 0.5).detach().abs().mean()
    assert float(before) > 0.45


@pytest.mark.parametrize("shuffle", [False, True])
def test_equal_generators_give_equal_bits_and_a_saved_state_goes_on(shuffle):
    config = {"target_kl": 0.01}

    def run(updates, policy_state=None, ppo_state=None, generator_state=None, first=0):
        ppo, generator = make_ppo(**config), torch.Generator().manual_seed(11)
        ppo.policy.is_shuffled = shuffle
        if policy_state is not None:
            ppo.policy.load_state_dict(policy_state)
            ppo.load_state_dict(ppo_state)
            generator.set_state(generator_state)
        rollout = Rollout(T)
        for number in range(first, first + updates):
            ppo.update(fill(rollout, ppo.policy, seed=number), generator, strength=0.1)
        return ppo, generator

    whole, _ = run(4)
    again, _ = run(4)
    half, generator = run(2)
    resumed, _ = run(2, half.policy.state_dict(), half.state_dict(), generator.get_state(), first=2)
    assert torch.equal(weights(whole.policy), weights(again.policy))
    for name, value in whole.policy.state_dict().items():
        assert torch.equal(resumed.policy.state_dict()[name], value), name
    assert torch.equal(resumed.rate, whole.rate)
    assert float(whole.rate) != pytest.approx(3e-4)


def test_a_saved_state_is_a_copy_of_the_rate():
    ppo = make_ppo(target_kl=0.01)
    state = ppo.state_dict()
    ppo.update(fill(Rollout(T), ppo.policy), DRAWS)
    assert float(state["learning_rate"]) == pytest.approx(3e-4)


# ----------------------------------------------------------------------------------------------------- guards


@pytest.mark.parametrize(
    "name", ["x", "reward", "action", "teacher_action", "log_prob", "value", "next_value"]
)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_samples_that_are_not_finite_have_no_part_and_are_counted(name, bad):
    ppo = make_ppo()
    rollout = fill(Rollout(T), ppo.policy)
    rollout[name][3, 2] = bad
    metrics = ppo.update(rollout, DRAWS, strength=0.5)
    assert metrics["train/invalid_samples"] == 1
    assert metrics["train/skipped_updates"] == 0
    assert all(math.isfinite(value) for value in metrics.values())
    assert all(torch.isfinite(value).all() for value in ppo.policy.state_dict().values())
    assert float(ppo.policy.observation_norm.count) == T * N - (name == "x")


def test_a_bad_reward_changes_nothing_but_its_own_episode():
    ppo = make_ppo()
    rollout = fill(Rollout(T), ppo.policy)
    clean = gae_of(rollout)[1]
    rollout["reward"][3, 2] = math.nan
    ppo.policy.value_norm.count.zero_()
    ppo.config = ppo.config.model_copy(update={"normalise_values": False})
    target = ppo._prepared(rollout)[0]["target"].view(T, N)
    others = [env for env in range(N) if env != 2]
    assert torch.allclose(target[:, others], clean[:, others], atol=FLOAT32)
    assert torch.allclose(target[4:, 2], clean[4:, 2], atol=FLOAT32)


def test_a_rollout_of_nothing_but_nan_leaves_a_finite_policy():
    ppo = make_ppo()
    rollout = fill(Rollout(T), ppo.policy)
    rollout["reward"].fill_(math.nan)
    assert ppo.update(rollout, DRAWS)["train/invalid_samples"] == T * N
    assert torch.isfinite(weights(ppo.policy)).all()


def test_a_gradient_that_is_not_finite_is_skipped_and_counted():
    calls, ppo = [], make_ppo(epochs=1)

    def poisoned(gradient):
        calls.append(gradient)
        return torch.full_like(gradient, math.nan) if len(calls) in (2, 3) else gradient

    ppo.policy.log_std.register_hook(poisoned)
    rollout = fill(Rollout(T), ppo.policy)
    assert ppo.update(rollout, DRAWS)["train/skipped_updates"] == 2
    assert ppo.skipped == 2
    assert torch.isfinite(weights(ppo.policy)).all()
    assert all(
        torch.isfinite(value).all() for state in ppo.optimiser.state.values() for value in state.values()
    )


def test_a_loss_that_is_not_finite_changes_nothing():
    ppo = make_ppo(normalise_values=False)
    before = weights(ppo.policy)
    rollout = fill(Rollout(T), ppo.policy)
    assert ppo.update(rollout, DRAWS, strength=math.nan)["train/skipped_updates"] == 8
    assert torch.equal(weights(ppo.policy), before)


# ----------------------------------------------------------------------------------------------------- a task


class PointTask:
    """A point in the plane: the action moves it, the reward is minus its distance, time ends episodes."""

    n, length, speed = 64, 16, 0.25

    def __init__(self, generator):
        self.generator = generator
        self.place = self.drawn()
        self.clock = torch.arange(self.n) % self.length  # not all at once

    def drawn(self):
        return torch.rand(self.n, 4, generator=self.generator) * 2 - 1

    def step(self, action):
        self.place = self.place + self.speed * action.clamp(-1, 1)
        self.clock += 1
        ended = self.clock >= self.length
        final = self.place
        self.place = torch.where(ended[:, None], self.drawn(), final)
        self.clock = torch.where(ended, 0, self.clock)
        return final, -final.norm(dim=-1), ended


def play(policy, ppo, task, generator, rollouts):
    """Mean reward of each rollout; learns unless ``ppo`` is None."""
    rollout, means = Rollout(32), []
    never = torch.zeros(task.n, dtype=torch.bool)
    for _ in range(rollouts):
        for t in range(rollout.steps):
            x = task.place
            step = policy.act({"x": x}, generator)
            final, reward, ended = task.step(step.action)
            add(rollout, t, policy, x, step, (reward, never, ended, final))
        rollout.close(policy.expected({"x": task.place}).detach())
        means.append(float(rollout["reward"].mean()))
        if ppo is not None:
            ppo.update(rollout, DRAWS)
    return means


def test_a_point_learns_to_go_home():
    """The best policy goes straight home and stays: about -0.2; drifting at random costs more than 1."""
    generator = torch.Generator().manual_seed(3)
    policy = ActorCritic(4, PolicyConfig(hidden=(32, 32), initial_std=0.5), generator)
    ppo = Ppo(
        policy, PpoConfig(rollout_steps=32, learning_rate=3e-3, epochs=4, gamma=0.9, entropy_weight=0.0)
    )
    means = play(policy, ppo, PointTask(generator), generator, 18)
    assert sum(means[:2]) / 2 < -1.0
    assert sum(means[-5:]) / 5 > -0.4
