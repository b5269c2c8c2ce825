"""World model: losses against NumPy, switches, units, learning, resume, NaN, memory of online features."""

import copy
import math

import numpy as np
import pytest
import torch
from scipy import stats

from tests.oracles import world_model as reference
from uuvtai.config.learning import WorldModelConfig
from uuvtai.learning.world_model import LOG_VAR_BOUNDS, N_TARGET, WorldModel, WorldModelLearner, calibration

N_OBS, STEPS, N_ENV = 30, 16, 32
SMALL = WorldModelConfig(hidden=(32, 32), latent=16, batch=256, steps=2, learning_rate=3e-3)

ROUNDING = 2e-5
"""Relative: float32 sums of a few hundred terms against float64."""

SAMPLING = 0.2
"""Around a mean square of one: what the issue allows; the variance of 24 x 2000 held-out residuals alone
gives 0.01."""


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def learn(learner, data, draws, valid=None):
    """From all of the data, or what is ``valid``."""
    every = torch.ones(data[1].shape[:2], dtype=torch.bool)
    return learner.update(*data, every if valid is None else valid, draws)


def transitions(seed=0, steps=STEPS, n_env=N_ENV, noisy=0.2):
    """obs, action, next_obs: targets follow the action, with ``noisy`` noise where column 24 is positive."""
    gen = generator(seed)
    obs = torch.randn(steps, n_env, N_OBS, generator=gen)
    action = torch.rand(steps, n_env, 4, generator=gen) * 2 - 1
    noise = torch.where(obs[..., 24:25] > 0, noisy, 0.02) * torch.randn(steps, n_env, N_TARGET, generator=gen)
    next_obs = obs.clone()
    next_obs[..., :N_TARGET] += 0.2 * action.repeat(1, 1, 6) + 0.1 * obs[..., 25:26] + noise
    return obs, action, next_obs


def trained(updates, config=SMALL, data=None, seed=0):
    """A model, its learner and the metrics of the last update, after some updates on the same rollout."""
    draws = generator(seed)
    model = WorldModel(N_OBS, config, draws)
    learner, metrics = WorldModelLearner(model, config), {}
    for _ in range(updates):
        metrics = learn(learner, data or transitions(), draws)
    return model, learner, metrics


def parameters(model):
    return torch.cat([p.detach().flatten() for p in model.parameters()])


def test_losses_are_those_of_the_oracle():
    config = SMALL.model_copy(update={"reconstruction_weight": 0.7, "dynamics_weight": 0.3})
    model, _, _ = trained(2, config)
    obs, action, next_obs = (part[0] for part in transitions(1))
    action = 2.0 * action  # half of them beyond what the environment clamps
    valid = torch.arange(N_ENV) % 3 > 0
    total, *parts = model.loss(obs, action, next_obs, valid)
    reconstruction, dynamics = reference.losses(
        model, *(part.double().numpy() for part in (obs, action, next_obs))
    )
    kept = valid.numpy()
    expected = reconstruction[kept].mean(), dynamics[kept].mean()
    np.testing.assert_allclose([part.item() for part in parts], expected, rtol=ROUNDING)
    assert total.item() == pytest.approx(0.7 * expected[0] + 0.3 * expected[1], rel=ROUNDING)


def test_log_variance_stays_in_bounds_with_a_gradient_everywhere():
    model = WorldModel(N_OBS, SMALL, generator())
    with torch.no_grad():
        model.decoder[-1].weight.zero_()
        model.decoder[-1].bias[N_TARGET:] = torch.linspace(-20, 20, N_TARGET)
    _, log_var = model.decode(torch.zeros(1, SMALL.latent))
    assert (log_var >= LOG_VAR_BOUNDS[0]).all() and (log_var <= LOG_VAR_BOUNDS[1]).all()
    log_var.sum().backward()
    assert (model.decoder[-1].bias.grad[N_TARGET:] > 0).all()


def test_it_learns_what_follows_and_where_it_is_uncertain():
    """Far below the targets' variance on unseen data, calibrated, and surer where the noise is weak."""
    config = SMALL.model_copy(update={"latent": 48, "hidden": (64, 64)})
    model, _, metrics = trained(200, config, transitions(steps=256, noisy=1.0))
    obs, action, next_obs = (part.flatten(0, 1) for part in transitions(7, steps=64, noisy=1.0))
    with torch.no_grad():
        _, mean, log_var = model.predict(obs, action)
    target, quiet = next_obs[:, :N_TARGET], obs[:, 24] < 0
    assert ((target - mean)[quiet].square().mean(dim=0) < 0.2 * target[quiet].var(dim=0)).all()
    square, _ = calibration(mean, log_var, target)
    assert square == pytest.approx(1.0, abs=SAMPLING)
    assert metrics["world_model/standardised_residual"] == pytest.approx(1.0, abs=SAMPLING)
    assert metrics["world_model/coverage_90"] == pytest.approx(0.9, abs=SAMPLING)
    assert metrics["world_model/latent_std"] > 0.01
    sigma = model.features(obs, action, next_obs)[:, 1]
    assert stats.spearmanr(sigma, obs[:, 24] > 0).statistic > 0.8, "the noise is far stronger there"


def test_features_are_the_papers_to_the_letter():
    """The root mean square of what was predicted wrongly, and sigma_t = mean(exp(log variance))."""
    model, _, _ = trained(3)
    obs, action, next_obs = (part[0] for part in transitions(5))
    with torch.no_grad():
        mean, log_var = model.decode(model.advance(model.encode(obs), action))
    error = next_obs[:, :N_TARGET] - mean
    expected = torch.stack([error.square().mean(1).sqrt(), log_var.exp().mean(1)], 1)
    torch.testing.assert_close(model.features(obs, action, next_obs), expected, rtol=ROUNDING, atol=1e-5)
    assert expected.std(dim=0).min() > 1e-3, "they vary at all"
    obs[0, 0] = next_obs[0, 0] = 1e9
    assert model.features(obs, action, next_obs)[0, 0] <= 100.0, "a jump is cut off"


def test_skill_is_told_by_name_and_only_where_something_changes():
    (obs, action, next_obs), names = transitions(), [f"t{i}" for i in range(N_TARGET)]
    next_obs[..., 3] = obs[..., 3]
    learner = WorldModelLearner(WorldModel(N_OBS, SMALL, generator()), SMALL, names)
    found = learn(learner, (obs, action, next_obs), generator()).items()
    told = {name.split("/")[-1]: value for name, value in found if "/skill/" in name}
    assert told.keys() == {*names} - {"t3"}
    before = (next_obs - obs)[..., :N_TARGET].square().mean((0, 1))
    expected = 1.0 - (next_obs[..., :N_TARGET].square().mean((0, 1)) / before).numpy()
    assert list(told.values()) == pytest.approx(np.delete(expected, 3), rel=0.4), "at birth it says 0"


# --------------------------------------------------------------------------------------------- random, resume


def test_only_the_handed_generator_is_drawn_from():
    before = torch.get_rng_state()
    first, _, _ = trained(2)
    assert torch.equal(torch.get_rng_state(), before)
    torch.rand(1)
    assert torch.equal(parameters(first), parameters(trained(2)[0]))
    assert not torch.equal(parameters(first), parameters(trained(2, seed=1)[0]))


def test_resume_is_bit_exact():
    draws = generator()
    model = WorldModel(N_OBS, SMALL, draws)
    learner = WorldModelLearner(model, SMALL)
    for _ in range(2):
        learn(learner, transitions(), draws)
    again = WorldModel(N_OBS, SMALL, generator(9))
    resumed = WorldModelLearner(again, SMALL)
    again.load_state_dict(model.state_dict())
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    draws_again = generator().set_state(draws.get_state())
    for one, g in ((learner, draws), (resumed, draws_again)):
        last = [learn(one, transitions(4), g) for _ in range(2)][-1]
    assert last["world_model/reconstruction_loss"] != 0.0
    for mine, theirs in zip(model.state_dict().values(), again.state_dict().values(), strict=True):
        assert torch.equal(mine, theirs)


# -------------------------------------------------------------------------------------------------- bad input


def test_rows_that_are_not_finite_count_like_rows_that_are_not_valid():
    bad = torch.zeros(STEPS, N_ENV, dtype=torch.bool)
    bad[:, ::5] = True
    with_nan = [part.clone() for part in transitions()]
    for part, value in zip(with_nan, (math.nan, math.inf, math.nan), strict=True):
        part[:, ::5, 0] = value
    found = []
    for data, valid in ((with_nan, None), (transitions(), ~bad)):
        draws = generator()
        model = WorldModel(N_OBS, SMALL, draws)
        learn(WorldModelLearner(model, SMALL), data, draws, valid)
        found.append(parameters(model))
    assert torch.equal(*found) and torch.isfinite(found[0]).all()
    assert not torch.equal(found[0], parameters(trained(1)[0])), "leaving rows out makes a difference"


def test_nothing_but_nan_changes_nothing():
    model, learner, _ = trained(1)
    before, norm = parameters(model).clone(), model.observation_norm.mean.clone()
    metrics = learn(learner, [part * math.nan for part in transitions()], generator())
    assert torch.equal(model.observation_norm.mean, norm)
    assert torch.equal(parameters(model), before)
    assert metrics["world_model/skipped_updates"] == SMALL.steps
    assert all(math.isfinite(value) for value in metrics.values())


def test_a_loss_that_is_not_finite_is_skipped_and_counted():
    model, learner, _ = trained(1)
    with torch.no_grad():
        model.decoder[-1].bias[0] = math.inf
    before = parameters(model).clone()
    metrics = learn(learner, transitions(), generator())
    assert metrics["world_model/skipped_updates"] == SMALL.steps == learner.skipped
    assert torch.equal(parameters(model), before)


def test_features_of_nan_are_zero():
    model, _, _ = trained(1)
    obs, action, next_obs = (part[0, :2].clone() for part in transitions())
    next_obs[0, 3] = math.nan
    found = model.features(obs, action, next_obs)
    assert found[0, 0] == 0.0 and found[1, 0] > 0.0


def test_too_narrow_an_observation_is_refused():
    with pytest.raises(ValueError, match="first 24 columns of the observation, but it has only 20"):
        WorldModel(20, SMALL, generator())


# ------------------------------------------------------------------------------------------------ calibration

SHARE_SAMPLING = 0.01
"""Four standard errors of a share of 100,000 samples are 0.0063 at most; of their mean square, 0.018 / 2."""


def test_residuals_by_hand():
    mean, log_var = torch.tensor([[1.0, 2.0]]), torch.tensor([[math.log(4.0), 0.0]])
    square, inside = calibration(mean, log_var, torch.tensor([[3.0, 5.0]]))  # 1 and 3 deviations
    assert square == pytest.approx(5.0, rel=1e-7) and inside == 0.5


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_true_variance_gives_one_and_nominal_coverage(factor):
    """And deviations that are said to be half as large are too sure."""
    gen = torch.Generator().manual_seed(0)
    log_var = torch.randn(100_000, generator=gen)
    target = torch.exp(0.5 * log_var) * torch.randn(100_000, generator=gen) + 3.0
    found = calibration(torch.full_like(target, 3.0), log_var - 2 * math.log(factor), target)
    inside = 2 * stats.norm.cdf(stats.norm.ppf(0.95) / factor) - 1
    assert found[0] == pytest.approx(factor**2, abs=2 * factor**2 * SHARE_SAMPLING)
    assert found[1] == pytest.approx(inside, abs=SHARE_SAMPLING)
