"""Learning what obstacles will do: samples, likelihood, scores, resuming; and the whole simulator."""

import copy
import math

import numpy as np
import pytest
import torch

from tests.command import Quiet
from tests.sim.test_observation_only import compared
from tests.small_sim import SmallSim
from uuvtai.common.enums import ANCHORS, COLUMNS, N_COLUMN, N_MODE
from uuvtai.common.errors import UserError
from uuvtai.config.loader import ConfigError, load_training
from uuvtai.learning import checkpoint
from uuvtai.learning import forecast as forecast_trainer
from uuvtai.learning.checkpoint import CheckpointError
from uuvtai.learning.forecast import (
    TIMES_S,
    ForecastTrainer,
    Mixture,
    MixtureNet,
    negative_log_likelihood,
    scores_of,
    watch,
)
from uuvtai.learning.policy_agent import load_agent
from uuvtai.learning.runner import TrainRequest, train
from uuvtai.sim.forecast_weights import packed_weights, read_weights

SMALL = {"train.num_envs": 8, "train.iterations": 4, "forecast_training.minibatches": 20}


def made_up(seed, n=400):
    """Moments of obstacles that go on or turn back at once, each half of the time; column 5 tells nothing."""
    generator = torch.Generator().manual_seed(seed)
    columns = torch.zeros(n, N_COLUMN)
    columns[:, 0] = 0.5 + torch.rand(n, generator=generator)
    columns[:, 5] = torch.rand(n, generator=generator)
    way = (
        columns[:, 0, None]
        * TIMES_S
        * torch.where(torch.rand(n, generator=generator) < 0.5, 1.0, -1.0)[:, None]
    )
    truth = torch.stack([way, torch.zeros_like(way)], -1)
    return columns, truth


@pytest.fixture
def config():
    return load_training("forecast", overrides=SMALL)


@pytest.fixture
def made(monkeypatch):
    """In place of simulators: moments that follow from seed and number of the first episode."""
    monkeypatch.setattr(forecast_trainer, "MEMORY", 1024)
    monkeypatch.setattr(forecast_trainer, "MINIBATCH", 64)
    monkeypatch.setattr(ForecastTrainer, "simulator", lambda *_arguments: None)
    monkeypatch.setattr(
        forecast_trainer, "watch", lambda _sim, _scenes, seed, first, _steps: (made_up(seed + first), 100)
    )


@pytest.fixture(scope="module")
def learned(tmp_path_factory, taichi_runtime):
    """A small simulator that forecasts by a network which has learnt nothing; else it is the stack with
    one."""
    path = tmp_path_factory.mktemp("net") / "f.safetensors"

    class LearnedSim(SmallSim):
        CHANGES = SmallSim.CHANGES | {"stack": "best", "forecast.learned": str(path)}

    net = MixtureNet(torch.Generator().manual_seed(3))
    path.write_bytes(packed_weights(net.weights()))
    found = LearnedSim()
    found.net = net
    return found


# ------------------------------------------------------------------------------------------------- likelihood


def test_the_likelihood_is_that_of_the_mixture():
    rng = np.random.default_rng(1)
    n = 20
    weight = rng.dirichlet(np.ones(N_MODE), n)
    place, sigma = rng.normal(0, 1, (n, N_MODE, ANCHORS, 2)), rng.uniform(0.1, 2, (n, N_MODE, ANCHORS, 2))
    truth = rng.normal(0, 1, (n, ANCHORS, 2))
    density = np.exp(-0.5 * ((truth[:, None] - place) / sigma) ** 2) / sigma / math.sqrt(2 * math.pi)
    expected = -np.log((weight * density.prod((-1, -2))).sum(-1))
    mixture = Mixture(*(torch.from_numpy(values) for values in (np.log(weight), place, sigma)))
    found = negative_log_likelihood(mixture, torch.from_numpy(truth))
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-9)


def drawn_from(n, seed):
    """(mixture, truth drawn from it)"""
    generator = torch.Generator().manual_seed(seed)
    weight = torch.tensor([0.5, 0.3, 0.2]).expand(n, -1)
    place = torch.randn(n, 3, ANCHORS, 2, generator=generator) * 3
    sigma = 0.1 + torch.rand(n, 3, ANCHORS, 2, generator=generator)
    which = torch.multinomial(weight, 1, generator=generator)[:, :, None, None].expand(-1, -1, ANCHORS, 2)
    truth = place.gather(1, which)[:, 0] + sigma.gather(1, which)[:, 0] * torch.randn(
        n, ANCHORS, 2, generator=generator
    )
    return Mixture(weight.log(), place, sigma), truth


def test_scores():
    mixture, truth = drawn_from(4000, 3)
    scores = scores_of(mixture, truth)
    last = np.linalg.norm(mixture.place[:, :, -1].numpy() - truth[:, None, -1].numpy(), axis=-1)
    assert scores["likeliest_median_m"] == pytest.approx(np.median(last[:, 0]), rel=1e-3)
    assert scores["nearest_p90_m"] == pytest.approx(np.quantile(last.min(-1), 0.9), rel=1e-3)
    assert scores["likeliest_said"] == pytest.approx(0.5)


# ------------------------------------------------------------------------------------------------------ learn


def test_it_learns_two_futures_and_how_probable_they_are(config, made):
    config = config.model_copy(
        update={"forecast_training": config.forecast_training.model_copy(update={"minibatches": 150})}
    )
    trainer = ForecastTrainer(config)
    first = trainer.evaluate()
    for _ in range(4):
        metrics = trainer.iterate()
    last = trainer.evaluate()
    assert metrics["train/moments"] == 1024, "what is kept is bounded"
    assert last["eval/nll_pool"] < first["eval/nll_pool"] - 5
    assert last["eval/nearest_p90_m_pool"] < 0.2
    assert last["eval/likeliest_said_pool"] == pytest.approx(0.5, abs=0.1)


def test_a_resumed_training_goes_on_bit_for_bit(config, made):
    one = ForecastTrainer(config)
    one.iterate()
    held = copy.deepcopy(one.state())
    one.iterate()
    other = ForecastTrainer(config)
    other.load_state(held)
    other.iterate()
    assert other.files() == one.files()
    for name, value in one.state()["env"].items():
        assert torch.equal(value, other.state()["env"][name])


def test_a_run_leaves_the_file_that_a_stack_forecasts_with(config, made, tmp_path):
    run = tmp_path / "run"
    request = TrainRequest(config=config, run_dir=run, iterations=2)
    document, _ = train(request, Quiet(), lambda *_arguments: {})
    assert document["iterations"] == 2
    halfway = read_weights(str(run))
    train(TrainRequest(resume=run), Quiet(), lambda *_arguments: {})
    found = checkpoint.newest(run)
    assert found.step == 4
    net = MixtureNet(torch.Generator())
    net.load_state_dict(found.model()["forecast"])
    whole = read_weights(str(run))
    assert all(np.array_equal(whole[name], values) for name, values in net.weights().items())
    assert any(not np.array_equal(whole[name], values) for name, values in halfway.items())
    with pytest.raises(CheckpointError, match="forecasts and does not drive"):
        load_agent(found, 1)


def test_what_cannot_be_learnt_is_refused(config, tmp_path):
    forecast = config.forecast.model_copy(update={"learned": "built-in"})
    with pytest.raises(UserError, match="leave it empty"):
        ForecastTrainer(config.model_copy(update={"forecast": forecast}))
    with pytest.raises(ConfigError, match="it learns on the CPU"):
        train(TrainRequest(config=config, run_dir=tmp_path / "run", device="cuda"), Quiet(), lambda *_a: {})


# ---------------------------------------------------------------------------------------------- the simulator


def test_what_is_watched_is_what_came(learned):
    learned.forget()
    (columns, truth), steps = watch(learned.sim, ((8, 6, 0.6),), 7, 0, 300)
    assert steps <= 8 * 300
    assert len(truth) > 50
    assert columns[:, :COLUMNS].isfinite().all() and (columns[:, COLUMNS:] == 0).all()
    far = truth[:, -1].norm(dim=-1)
    assert far.max() < 2.5 * 0.6 + 0.5 + 1e-3, "no obstacle is faster than its scene says"
    ahead = (truth[:, 0] - torch.stack([0.5 * columns[:, 0], 0 * far], -1)).norm(dim=-1)
    assert ahead.median() < 0.1, "most obstacles go on as they are tracked"
    sim, s = learned.sim, learned.sim.s
    there = sim.rows(s.forecast.radius_m)[..., 0] >= 0
    columns, share = (
        torch.from_numpy(sim.rows(field)[there]) for field in (s.mixture.column, s.futures.share)
    )
    said = learned.net(columns).log_weight.exp()
    likeliest = torch.nn.functional.one_hot(said.argmax(-1), N_MODE) == 1
    torch.testing.assert_close(share, said.masked_fill(likeliest, 0.0), atol=2e-5, rtol=0)


def test_futures_do_not_depend_on_the_truth(learned):
    learned.forget()
    learned.sim.observe()
    try:
        actions, differing, written = compared(learned)
    finally:
        learned.forget()
    assert (differing, written) == ([], set())
    assert actions.abs().mean() > 0.1


def test_a_forecast_is_the_same_in_any_row_and_company(learned):
    found = []
    for rows, episodes in (([0, 1], [0, 1]), ([6, 3, 0], [0, 1, 5])):
        learned.forget()
        learned.begin(episodes, seed=4, rows=rows)
        for _ in range(100):
            learned.sim.step()
        arrays = learned.arrays("futures", "past", "mixture", "forecast")
        found.append([{k: v[row] for k, v in arrays.items() if len(v) == 8} for row in rows[:2]])
    for one, other in zip(*found, strict=True):
        assert [name for name in one if not np.array_equal(one[name], other[name])] == []
    assert found[0][0]["futures.share"].any()
