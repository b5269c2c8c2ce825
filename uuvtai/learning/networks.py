"""Networks and what they need: perceptrons, actor, critic, normalisation, Adam, products, a NaN guard."""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import Any, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from uuvtai.common.errors import SettingError, UserError
from uuvtai.config.learning import PolicyConfig

_ACTIVATIONS = {"elu": lambda: nn.ELU(inplace=True), "tanh": nn.Tanh, "relu": lambda: nn.ReLU(inplace=True)}


def mlp(
    sizes: Sequence[int], activation: str, generator: torch.Generator, out_gain: float = 1.0
) -> nn.Sequential:
    """Layers of these widths (input, hidden ..., output), an activation after every one but the last; weights
    orthogonal with gain sqrt 2, the last layer's with ``out_gain``."""
    *hidden, last = itertools.pairwise(sizes)
    layers: list[nn.Module] = []
    for n_in, n_out in hidden:
        layers += [linear(n_in, n_out, math.sqrt(2.0), generator), _ACTIVATIONS[activation]()]
    return nn.Sequential(*layers, linear(*last, out_gain, generator))


def linear(n_in: int, n_out: int, gain: float, generator: torch.Generator) -> nn.Linear:
    """One layer, weights orthogonal with this gain, bias zero."""
    with torch.random.fork_rng(devices=()):  # its own initial weights come from the global generator
        layer = nn.Linear(n_in, n_out)
    nn.init.orthogonal_(layer.weight, gain, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer


# ------------------------------------------------------------------------------------------------------------
# Running mean and deviation in float64, merged batch by batch exactly (Chan, Golub, LeVeque 1979), and the
# scaling they give.


CACHE_ROWS = 2048
"""rows in one pass on a CPU: what a network makes of them, or their float64 copy, stays in the cache"""
MIN_STD = 1e-2  # least deviation of a column, in its unit: a constant column must not become noise


class Moments(NamedTuple):
    """Of samples of ``width`` columns, float64."""

    mean: Tensor
    m2: Tensor
    """(width,) both; sum of squared differences from the mean"""
    n: Tensor
    """() number of samples"""


def moments_of(x: Tensor) -> Moments:
    """Moments of the rows of x (..., width); a row that is not finite in every column is left out."""
    rows = x.detach().reshape(-1, x.shape[-1])
    kept = torch.isfinite(rows.sum(dim=1))
    if not bool(kept.all()):
        rows = rows[kept]
    zeros = functools.partial(torch.zeros, dtype=torch.float64, device=x.device)
    total = Moments(zeros(rows.shape[1]), zeros(rows.shape[1]), zeros(()))
    for chunk in rows.split(CACHE_ROWS) if len(rows) else ():
        part = chunk.double()
        mean = part.mean(dim=0)
        m2 = (part - mean).square().sum(dim=0)
        total = combined(total, Moments(mean, m2, part.new_tensor(float(len(part)))))
    return total


def combined(a: Moments, b: Moments) -> Moments:
    """Moments of the samples of both (Chan et al., equation 1.5)."""
    n = a.n + b.n
    share = b.n / n.clamp(min=1.0)
    difference = b.mean - a.mean
    return Moments(a.mean + share * difference, a.m2 + b.m2 + difference.square() * (a.n * share), n)


class RunningNorm(nn.Module):
    """Scales columns to mean 0 and deviation 1 by all samples so far; before the first one not at all."""

    def __init__(self, width: int, clip: float = 10.0) -> None:
        """``clip``: standard deviations beyond which normalised values are cut off."""
        super().__init__()
        self.clip = clip
        zeros = functools.partial(torch.zeros, dtype=torch.float64)
        self.mean, self.m2 = nn.Buffer(zeros(width)), nn.Buffer(zeros(width))
        self.count = nn.Buffer(zeros(()))

    def update(self, x: Tensor) -> None:
        """Add the rows of x (..., width); rows that are not finite are left out."""
        moments = Moments(self.mean, self.m2, self.count)
        for own, united in zip(moments, combined(moments, moments_of(x)), strict=True):
            own.copy_(united)

    def std(self) -> Tensor:
        """(width,) deviation, float64, at least ``MIN_STD``; 1 before the first sample."""
        variance = torch.where(self.count > 0, self.m2 / self.count.clamp(min=1.0), 1.0)
        return variance.sqrt().clamp(min=MIN_STD)

    def forward(self, x: Tensor) -> Tensor:
        """Normalised x (..., width), float32, within +-clip; what is not a number becomes 0, the mean."""
        y = x - self.mean.float()
        limit = torch.where(self.count > 0, self.clip, math.inf).float()
        y.mul_((1.0 / self.std()).float()).clamp_(-limit, limit)
        return y.nan_to_num_(nan=0.0, posinf=self.clip, neginf=-self.clip)

    def inverse(self, y: Tensor) -> Tensor:
        """The x whose normalised value is y (..., width), float32."""
        return torch.addcmul(self.mean.float(), y, self.std().float())


# ------------------------------------------------------------------------------------------------------------
# Actor and critic: a diagonal Gaussian over the four commands and the value, with the normalisers of both
# inside the module.


NUM_ACTIONS = 4
_MEAN_GAIN = 0.01  # of the last layer: small first actions (Andrychowicz et al. 2021)
HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
View = dict[str, Tensor]
"""what is known of N envs, by name, each (N, ...)"""


class PolicyStep(NamedTuple):
    """What the policy decided for N envs."""

    action: Tensor
    """(N, n_action) drawn, unclamped: the environment clamps"""
    log_prob: Tensor
    value: Tensor
    """(N,) both: [nat]; expected return"""
    mean: Tensor


def log_prob(action: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """(...,) log density [nat] of actions (..., n) under a diagonal Gaussian of log deviation (n,)."""
    scaled = (action - mean) * torch.exp(-log_std)
    return -0.5 * scaled.square().sum(dim=-1) - (log_std.sum() + log_std.shape[-1] * HALF_LOG_2PI)


def entropy(log_std: Tensor) -> Tensor:
    """Differential entropy [nat] of such a Gaussian, a scalar."""
    return log_std.sum() + log_std.shape[-1] * (0.5 + HALF_LOG_2PI)


class Policy(nn.Module, ABC):
    """Actor and critic as PPO sees them: two separate networks on the same inputs."""

    inputs: tuple[str, ...]
    """of a ``View``, what actor and critic are told"""
    actor: Any
    critic: Any
    log_std: nn.Parameter
    """(n_action,), log deviation of the action"""
    value_norm: RunningNorm
    is_shuffled, most_std = False, math.inf
    critic_rate: float | None = None
    """whether minibatches are drawn at random in any case; the largest deviation; a learning rate of the
    critic's own, whose gradient is then cut by itself"""

    def __init__(self, config: PolicyConfig) -> None:
        """SettingError for a deviation that begins below its floor."""
        super().__init__()
        if config.initial_std < config.min_std:
            least = f"the floor policy.min_std {config.min_std:g}"
            raise SettingError(f"policy.initial_std {config.initial_std:g} lies below {least}")
        self.config = config

    def prepared(self, view: View) -> View:
        """The inputs as ``mean_of`` and ``value_of`` want them."""
        return {name: view[name] for name in self.inputs}

    @abstractmethod
    def mean_of(self, inputs: View) -> Tensor:
        """(..., n_action) mean action, float32, of prepared inputs."""

    @abstractmethod
    def value_of(self, inputs: View) -> Tensor:
        """(...,) expected return in the critic's units, float32, of prepared inputs."""

    def parts(self) -> dict[str, nn.Module]:
        """What is kept of it, by name in a checkpoint: ``policy`` is what drives."""
        return {"policy": self}

    def observe(self, view: View) -> None:
        """Take inputs into the statistics that they are scaled by, where there are some."""

    @torch.no_grad()
    def act(self, view: View, generator: torch.Generator) -> PolicyStep:
        """Draw actions for N envs with noise from a CPU generator."""
        inputs = self.prepared(view)
        both = (functools.partial(by_part, of, inputs) for of in (self.mean_of, self.value_of))
        mean, value = side_by_side(*both, device=self.log_std.device.type)
        noise = torch.randn(mean.shape, generator=generator).to(mean.device)
        action = torch.addcmul(mean, noise, self.log_std.exp())
        return PolicyStep(action, log_prob(action, mean, self.log_std), self.value_norm.inverse(value), mean)

    @torch.no_grad()
    def expected(self, view: View) -> Tensor:
        """(N,) expected return, in units of the reward."""
        return self.value_norm.inverse(by_part(self.value_of, self.prepared(view)))

    @torch.no_grad()
    def floor_std(self) -> None:
        """Bring deviations back into their bounds: clamping inside would stop their gradient there."""
        self.log_std.clamp_(math.log(self.config.min_std), math.log(self.most_std))

    @torch.no_grad()
    def learn_returns(self, returns: Tensor) -> None:
        """Add returns (n, 1) to the value's statistics and change the critic's last layer so that no value
        changes (Pop-Art: van Hasselt et al. 2016, equation 9)."""
        old_mean, old_std = self.value_norm.mean.clone(), self.value_norm.std()
        self.value_norm.update(returns)
        mean, std = self.value_norm.mean, self.value_norm.std()
        *_, last = (layer for layer in self.critic.modules() if isinstance(layer, nn.Linear))
        last.weight.copy_(last.weight * (old_std / std))
        last.bias.copy_((last.bias * old_std + old_mean - mean) / std)


class ActorCritic(Policy):
    """Perceptrons on the raw input ``x`` (..., n_in), which it normalises."""

    inputs = ("x",)

    def __init__(self, n_in: int, config: PolicyConfig, generator: torch.Generator) -> None:
        super().__init__(config)
        self.n_in = n_in
        self.actor = mlp((n_in, *config.hidden, NUM_ACTIONS), config.activation, generator, _MEAN_GAIN)
        self.critic = mlp((n_in, *config.hidden, 1), config.activation, generator)
        self.log_std = nn.Parameter(torch.full((NUM_ACTIONS,), math.log(config.initial_std)))
        self.observation_norm = RunningNorm(n_in)
        self.value_norm = RunningNorm(1, math.inf)

    def prepared(self, view: View) -> View:
        return {"x": self.observation_norm(view["x"])}

    def mean_of(self, inputs: View) -> Tensor:
        return self.actor(inputs["x"])

    def value_of(self, inputs: View) -> Tensor:
        return self.critic(inputs["x"]).squeeze(-1)

    def observe(self, view: View) -> None:
        self.observation_norm.update(view["x"])


@torch.no_grad()
def by_part(function: Callable[[View], Tensor], inputs: View) -> Tensor:
    """A function of many rows, on a CPU ``CACHE_ROWS`` at a time; nothing of it can be learnt from."""
    first = next(iter(inputs.values()))
    if first.device.type != "cpu" or len(first) <= CACHE_ROWS:
        return function(inputs)
    rows = range(0, len(first), CACHE_ROWS)
    return torch.cat([function({n: part[i : i + CACHE_ROWS] for n, part in inputs.items()}) for i in rows])


# ------------------------------------------------------------------------------------------------------------
# Pieces of a training's work on all cores. Networks over a few thousand rows are too small for torch's own
# threads, which wait for each other at every product; here each thread takes whole pieces.


_T = TypeVar("_T")
_threads: ContextVar[int] = ContextVar("threads")
"""for pieces, while torch's own rest"""


@contextlib.contextmanager
def torch_threads_rest() -> Iterator[None]:
    """Between the pieces torch computes on one thread: its own are slower on networks of this size."""
    threads = torch.get_num_threads()
    token = _threads.set(threads)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _threads.reset(token)


def side_by_side(*pieces: Callable[[], _T], device: str = "cpu") -> list[_T]:
    """What each piece gives, in their order; a piece runs on one thread, so threads change no result."""
    threads = _threads.get(None) or torch.get_num_threads()
    if device != "cpu" or threads == 1:
        return [piece() for piece in pieces]
    flushes = float(torch.tensor(1e-40) * 1.0) == 0.0
    return list(_pool(threads, flushes).map(lambda piece: piece(), pieces))


@functools.cache
def _pool(threads: int, flushes: bool) -> ThreadPoolExecutor:
    def begin() -> None:
        torch.get_num_threads()  # else the thread's first product sets it to what counts for all then
        torch.set_num_threads(1)
        torch.set_flush_denormal(flushes)

    return ThreadPoolExecutor(threads, "uuvtai-learn", begin)


LARGEST_ERROR = 1e-5
"""of a product in float32, in parts of its largest number; in bfloat16 it would be 100 times as large"""


@contextlib.contextmanager
def fast_products() -> Iterator[None]:
    """Float32 products by oneDNN in place of MKL where that is as exact: faster on CPUs of AMD."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(fastest_precision())
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@functools.cache
def fastest_precision() -> Literal["medium", "highest"]:
    """'medium' takes the other library, and on some CPUs bfloat16 with it, as one product's error tells."""
    a, b = (torch.randn(256, 256, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1))
    before, exact = torch.get_float32_matmul_precision(), a.double() @ b.double()
    torch.set_float32_matmul_precision("medium")
    error = float(((a @ b).double() - exact).abs().max() / exact.abs().max())
    torch.set_float32_matmul_precision(before)
    return "medium" if error < LARGEST_ERROR else "highest"


class PlainAdam(torch.optim.Adam):
    """``torch.optim.Adam`` without torch's compiler, which its class imports when one is built and when it
    steps: that takes four seconds, and nothing here compiles by it. Same numbers, same states."""

    step = torch.no_grad()(getattr(torch.optim.Adam.step, "__wrapped__", torch.optim.Adam.step))
    """torch's own without what switches its compiler off around it"""

    def __init__(self, *arguments, **named) -> None:
        _spare_compiler()
        super().__init__(*arguments, **named)


def _spare_compiler() -> None:
    """Tell methods of optimisers that they are off for the compiler already, unless it has been imported."""
    if "torch._dynamo" in sys.modules:
        return
    for method in vars(torch.optim.Optimizer).values():
        inner = getattr(method, "__wrapped__", None)
        if inner is not None and not hasattr(inner, "__dynamo_disable"):
            inner.__dynamo_disable = inner


class AdamLearner:
    """Steps of Adam, but for those that would spoil the networks."""

    def __init__(self, parameters: Iterable[Any], **options: Any) -> None:
        """``parameters`` and ``options`` of ``torch.optim.Adam``."""
        self.optimiser = PlainAdam(parameters, **options)
        self.skipped = 0
        """steps left out because the gradient was not finite, or zero for want of valid samples"""

    def step(self, loss: Tensor | None = None, most: float = math.inf) -> bool:
        """A step on ``loss`` (None: by gradients that are there), norms cut to ``most``; was there any?"""
        if loss is not None:
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
        groups = self.optimiser.param_groups
        norms = [float(nn.utils.clip_grad_norm_(group["params"], most)) for group in groups]
        is_sound = 0.0 < sum(norms) < math.inf
        if is_sound:
            self.optimiser.step()
        self.skipped += not is_sound
        return is_sound

    def state_dict(self) -> dict[str, Any]:
        return {"optimiser": self.optimiser.state_dict(), "skipped": self.skipped}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.optimiser.load_state_dict(state["optimiser"])
        self.skipped = int(state["skipped"])


# ------------------------------------------------------------------------------------------------------------
# What is not a finite number neither spreads nor stays silent: it is replaced, counted by name, and
# iteration after iteration an error.


PREFIX = "non_finite/"  # of the metrics that count what was replaced; they are there only when something was
OBSERVATION = "observation"
_ROWS_TOLD = 4


class TrainingError(UserError, RuntimeError):
    """Training cannot go on: what is wrong, since when, and what to type next."""


class Guard:
    """Replaces values that are not finite and counts them, without a wait for the device."""

    def __init__(
        self, columns: Sequence[tuple[str, slice]], num_envs: int, patience: int, device: torch.device
    ) -> None:
        """``columns``: of the observation; ``patience``: bad iterations in a row before it is an error."""
        self.columns, self.patience = tuple(columns), patience
        self._rows = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._none = torch.zeros_like(self._rows)
        self._counts: dict[str, Tensor] = {}  # of what was replaced, column by column
        self.bad_in_a_row = 0

    def values(
        self, name: str, values: Tensor, fill: Tensor | float = 0.0, counted: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """``values`` (N, ...) with ``fill`` in place of what is not finite, and which rows (N,) were bad.
        ``OBSERVATION`` is counted by columns; ``counted`` (N,): rows that count."""
        if values.device.type == "cpu" and math.isfinite(values.sum()):  # elsewhere that is a wait
            return values, self._none
        bad = ~torch.isfinite(values)
        rows = bad.view(len(bad), -1)
        counting = rows if counted is None else rows & counted[:, None]
        self._counts[name] = counting.sum(dim=0) + self._counts.get(name, 0)
        self._rows |= counting.any(dim=1)
        return torch.where(bad, fill, values), rows.any(dim=1)

    def take(self) -> dict[str, float]:
        """Counts above zero since the last call, by name."""
        by_column = self._counts.pop(OBSERVATION, torch.zeros(0))
        found = {name: by_column[place] for name, place in self.columns} | self._counts
        self._counts = {}
        return {f"{PREFIX}{name}": float(n) for name, part in found.items() if (n := part.sum())}

    def check(self, iteration: int, metrics: dict[str, float], scenarios: tuple[Tensor, Tensor]) -> None:
        """Count an iteration; TrainingError after ``patience`` in a row whose metrics tell of something bad.
        ``scenarios``: seed and episode (N,) that the envs are in."""
        replaced = {name.removeprefix(PREFIX): n for name, n in metrics.items() if name.startswith(PREFIX)}
        complaints = [f"{int(n)} values of {name} not finite" for name, n in replaced.items()]
        if skipped := int(metrics["train/skipped_updates"]):
            complaints.append(f"{skipped} updates left out because loss or gradient was not finite")
        rows = self._rows.nonzero().flatten().tolist()
        self._rows.zero_()
        self.bad_in_a_row = self.bad_in_a_row + 1 if complaints else 0
        if self.bad_in_a_row < self.patience:
            return
        found = [(row, *(int(number[row]) for number in scenarios)) for row in rows[:_ROWS_TOLD]]
        envs = "".join(f"; env {row} (seed {seed}, episode {episode})" for row, seed, episode in found)
        raise TrainingError(
            f"iterations {iteration - self.bad_in_a_row + 1} to {iteration} were all bad: "
            f"{'; '.join(complaints)}{envs}. The networks did not learn it. If updates were left out, take "
            "smaller steps: uuv train --resume RUN --set ppo.learning_rate=1e-4. If an observation or a "
            "reward is not finite, the simulator is at fault: please report seed and episode"
        )
