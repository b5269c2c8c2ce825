"""A trained policy driving: the mean action without exploration noise, with the world model's memory of
every row.

What a row does must not depend on its neighbours, the batch's size or the number of threads. The networks
therefore always see ``CHUNK`` rows at once, the last chunk filled up: equal shapes take equal paths through
the matrix products.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeVar

import torch
from torch import nn

from uuvtai.config.learning import LearningConfig
from uuvtai.learning.checkpoint import MODEL, Checkpoint, CheckpointError
from uuvtai.learning.networks import NUM_ACTIONS, ActorCritic
from uuvtai.learning.world_model import N_FEATURES, WorldModel

CHUNK = 64
"""rows that go through the networks together"""


class AgentDecision(NamedTuple):
    """What the policy chooses for N rows, and what it thinks of their state."""

    action: torch.Tensor
    """(N, 4) mean action in parts of the vehicle's limits, within [-1, 1]"""
    value: torch.Tensor
    """(N,) expected return"""
    std: torch.Tensor
    """(4,) of the exploration it was trained with"""
    residual: torch.Tensor
    """(N,) of the world model's last prediction; 0 = none yet, or no world model"""
    uncertainty: torch.Tensor
    """(N,) of that prediction"""


class PolicyAgent:
    """Drives ``num_envs`` rows. ``decide`` looks, ``advance`` goes on to the next step; ``reset`` when a row
    begins another episode."""

    def __init__(
        self,
        policy: ActorCritic,
        world_model: WorldModel | None,
        num_envs: int,
        device: torch.device | str = "cpu",
    ) -> None:
        """``world_model``: None where the policy was trained without its features. The networks are used, not
        copied."""
        self.policy, self.world_model, self.device = policy, world_model, torch.device(device)
        self._n_obs = policy.n_in - N_FEATURES
        rows = num_envs
        self._obs, self._last_obs = (torch.zeros(rows, self._n_obs, device=device) for _ in range(2))
        self.mean_action, self._last_action = (
            torch.zeros(rows, NUM_ACTIONS, device=device) for _ in range(2)
        )
        """(num_envs, 4) of the last decision, before it was cut off to [-1, 1]"""
        self._has_last = torch.zeros(rows, dtype=torch.bool, device=device)
        self._hold, self._age = policy.config.hold_steps, torch.zeros(rows, dtype=torch.int64, device=device)
        self._said = torch.zeros(rows, 3, device=device)
        self.decision = AgentDecision(*(torch.zeros(0) for _ in AgentDecision._fields))
        """the last one; where an older one is held, what the networks said then"""

    def reset(self, rows: torch.Tensor) -> None:
        """Forget the last step of the rows (num_envs,) where this is not 0."""
        kept = rows.to(self.device) == 0
        self._has_last &= kept
        self._age *= kept

    @torch.no_grad()
    def decide(self, obs: torch.Tensor) -> AgentDecision:
        """Decision for observations (num_envs, n_obs); changes nothing that the next one depends on."""
        fill = self.policy.observation_norm.mean[: self._n_obs].float()
        self._obs[:] = torch.where(torch.isfinite(obs), obs, fill)
        due = self._due()
        if len(due):
            self._think(due)
        value, residual, uncertainty = self._said.clone().T
        self.decision = AgentDecision(
            self.mean_action.clamp(-1.0, 1.0), value, self.policy.log_std.exp(), residual, uncertainty
        )
        return self.decision

    def advance(self) -> None:
        """The last decision has been carried out."""
        due = self._due()
        self._last_obs[due], self._last_action[due] = self._obs[due], self.mean_action[due]
        self._has_last[due] = True
        self._age += 1

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        """Decide and carry it out: actions (num_envs, 4)."""
        action = self.decide(obs).action
        self.advance()
        return action

    def _due(self) -> torch.Tensor:
        """Rows whose decision is not held any more."""
        return (self._age % self._hold == 0).nonzero().flatten()

    def _think(self, rows: torch.Tensor) -> None:
        """Ask the networks about these rows."""
        obs = self._obs[rows]
        x = torch.cat([obs, self._features(rows, obs)], dim=1)
        self.mean_action[rows] = by_chunk(lambda part: self.policy.distribution(part)[0], x)
        self._said[rows] = torch.stack([by_chunk(self.policy.value, x), x[:, -2], x[:, -1]], dim=1)

    def _features(self, rows: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        if self.world_model is None:
            return obs.new_zeros(len(obs), N_FEATURES)
        found = by_chunk(self.world_model.features, self._last_obs[rows], self._last_action[rows], obs)
        return torch.where(self._has_last[rows, None], found, 0.0)


def by_chunk(function: Callable[..., torch.Tensor], *inputs: torch.Tensor) -> torch.Tensor:
    """Function of inputs (n, ...), ``CHUNK`` rows at a time, the last chunk filled up with its first row."""
    parts = []
    for i in range(0, len(inputs[0]), CHUNK):
        chunk = [tensor[i : i + CHUNK] for tensor in inputs]
        missing = CHUNK - len(chunk[0])
        parts.append(
            function(
                *(
                    torch.cat([t, t[:1].expand(missing, *t.shape[1:])]) if missing else t.contiguous()
                    for t in chunk
                )
            )
        )
    return torch.cat(parts)[: len(inputs[0])]


def _check_sizes(parts: dict[str, Any], config: LearningConfig, n_obs: int) -> None:
    """Raise ValueError where the networks of a config are not as wide as the tensors that came with it,
    before anything is made so wide."""
    n_in, latent = n_obs + N_FEATURES, config.world_model.latent
    nets = [
        ("policy", "actor", (n_in, *config.policy.hidden)),
        ("policy", "critic", (n_in, *config.policy.hidden)),
    ]
    if config.world_model.enabled and config.world_model.as_features:
        hidden = config.world_model.hidden
        nets += [
            ("world_model", "encoder", (n_obs, *hidden, latent)),
            ("world_model", "dynamics", (latent + NUM_ACTIONS, *hidden, latent)),
        ]
        nets += [("world_model", "decoder", (latent, *hidden))]
    for part, net, widths in nets:
        for number, (first, last) in enumerate(itertools.pairwise(widths)):
            name = f"{net}.{2 * number}.weight"
            if parts[part][name].shape != (last, first):
                raise ValueError(
                    f"{part}.{name} is {tuple(parts[part][name].shape)} instead of {(last, first)}"
                )


_NO_NETWORK = {
    "forecast_training": "forecasts and does not drive; give it to an agent that does: --set "
    "forecast.learned=RUN",
    "parameter_search": "numbers for the behaviour tree, no network that could be exported; they drive as "
    "--agent best, or as stack.yaml of the run",
    "surrogate": "a policy over a set of obstacles, which looks at the simulator itself; it drives in 'uuv "
    "eval' and 'uuv sweep', and is exported by 'uuv export'",
}
"""what cannot be a ``PolicyAgent``, by ``LearningConfig.learner``"""


def load_agent(checkpoint: Checkpoint, num_envs: int, device: torch.device | str = "cpu") -> PolicyAgent:
    """PolicyAgent with the networks of a checkpoint. Raises CheckpointError where they do not fit what its
    config says."""
    config = checkpoint.config
    if config.learner in _NO_NETWORK:
        raise CheckpointError(f"{checkpoint.path}: {_NO_NETWORK[config.learner]}")
    parts, generator = checkpoint.model(), torch.Generator()
    with fitting(checkpoint):
        n_obs = max(row["stop"] for row in checkpoint.manifest.observation_table)
        _check_sizes(parts, config, n_obs)
        policy = ActorCritic(n_obs + N_FEATURES, config.policy, generator)
        policy.load_state_dict(parts["policy"])
        world_model = None
        if config.world_model.enabled and config.world_model.as_features:
            world_model = WorldModel(n_obs, config.world_model, generator)
            world_model.load_state_dict(parts["world_model"])
    for module in (policy, world_model):
        if module is not None:
            finite(module, checkpoint).to(device)
    return PolicyAgent(policy, world_model, num_envs, device)


Net = TypeVar("Net", bound=nn.Module)


@contextlib.contextmanager
def fitting(checkpoint: Checkpoint) -> Iterator[None]:
    """Turn what networks of another shape raise into a CheckpointError."""
    try:
        yield
    except CheckpointError:
        raise
    except (KeyError, ValueError, RuntimeError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"{checkpoint.path / MODEL}: its networks are not those of its config ({error}); take another one"
        ) from None


def finite(net: Net, checkpoint: Checkpoint) -> Net:
    """The network, to act with. Raises CheckpointError where a weight is not finite."""
    for name, tensor in net.state_dict().items():
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(
                f"{checkpoint.path / MODEL}: {name} is not finite: the training failed; take an older "
                "checkpoint"
            )
    return net.eval()
