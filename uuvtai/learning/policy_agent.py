"""A trained policy driving: the mean action without exploration noise. What a row does must not depend on its
neighbours, the batch's size or the number of threads. The networks therefore always see ``CHUNK`` rows at
once: equal shapes take equal paths through the matrix products."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from uuvtai.common.files import FileError
from uuvtai.learning.checkpoint import MODEL, Checkpoint, CheckpointError, refused
from uuvtai.learning.networks import NUM_ACTIONS, ActorCritic
from uuvtai.learning.world_model import N_FEATURES, WorldModel

Device = torch.device | str
CHUNK = 64  # rows that go through the networks together


class AgentDecision(NamedTuple):
    """What the policy chooses for N rows, and what it thinks of their state."""

    action: Tensor
    """(N, 4) mean action in parts of the vehicle's limits, within [-1, 1]"""
    value: Tensor
    """(N,) expected return"""
    std: Tensor
    """(4,) of the exploration it was trained with"""
    residual: Tensor
    """(N,) of the world model's last prediction; 0 = none yet, or no world model"""
    uncertainty: Tensor
    """(N,) of that prediction"""


class OneDecision(nn.Module):
    """The networks for one decision, without memory."""

    def __init__(self, policy: ActorCritic, world_model: WorldModel | None) -> None:
        """``world_model``: None where the policy was trained without its features."""
        super().__init__()
        self.policy, self.world_model = policy, world_model
        self.fill = nn.Buffer(policy.observation_norm.mean[: policy.n_in - N_FEATURES].float())
        """(n_obs,) what counts where a value is not finite"""

    def forward(
        self, obs: Tensor, last_obs: Tensor, last_action: Tensor, has_last: Tensor
    ) -> tuple[Tensor, ...]:
        """(mean action (N, 4), value (N,), residual and uncertainty (N, 2)) for the newest observations
        (N, n_obs), those of the last decision, its action (N, 4), and whether (N,) bool there was one."""
        obs, last_obs = (torch.where(torch.isfinite(seen), seen, self.fill) for seen in (obs, last_obs))
        features = obs.new_zeros(obs.shape[0], N_FEATURES)
        if self.world_model is not None:
            found = self.world_model.features(last_obs, last_action, obs)
            features = torch.where(has_last[:, None], found, features)
        inputs = self.policy.prepared({"x": torch.cat([obs, features], dim=1)})
        value = self.policy.value_norm.inverse(self.policy.value_of(inputs))
        return self.policy.mean_of(inputs), value, features


class HeldAgent(ABC):
    """Drives rows by decisions that are held for some control steps."""

    world_model: WorldModel | None = None

    def __init__(self, num_envs: int, hold_steps: int, device: Device) -> None:
        self.device, self._hold = torch.device(device), hold_steps
        self._age = torch.zeros(num_envs, dtype=torch.int64, device=device)
        """control steps of every row's episode"""
        std = torch.zeros(NUM_ACTIONS, device=device)
        self.decision = AgentDecision(self._zeros(4), self._zeros(), std, self._zeros(), self._zeros())
        """the last one; 0 is what nobody says"""

    def reset(self, rows: Tensor) -> None:
        """Forget the last step of the rows (num_envs,) where this is not 0."""
        self._age *= rows.to(self.device) == 0

    @abstractmethod
    def decide(self, obs: Tensor) -> AgentDecision:
        """Decision for observations (num_envs, n_obs); changes nothing that the next one depends on."""

    def advance(self) -> None:
        """The last decision has been carried out."""
        self._age += 1

    def act(self, obs: Tensor) -> Tensor:
        """Decide and carry it out: actions (num_envs, 4)."""
        action = self.decide(obs).action
        self.advance()
        return action

    def _zeros(self, *shape: int) -> Tensor:
        """(num_envs, *shape)."""
        return torch.zeros(len(self._age), *shape, device=self.device)

    def _due(self) -> Tensor:
        """Rows whose decision is not held any more."""
        return (self._age % self._hold == 0).nonzero().flatten()


class PolicyAgent(HeldAgent):
    """Drives ``num_envs`` rows by a policy on observation vectors."""

    def __init__(
        self, policy: ActorCritic, world_model: WorldModel | None, num_envs: int, device: Device = "cpu"
    ) -> None:
        super().__init__(num_envs, policy.config.hold_steps, device)
        self.policy, self.world_model = policy, world_model
        self._one = OneDecision(policy, world_model)
        zeros, n_obs = self._zeros, policy.n_in - N_FEATURES
        self._obs, self._last_obs, self._last_action = zeros(n_obs), zeros(n_obs), zeros(NUM_ACTIONS)
        self._said = zeros(NUM_ACTIONS), zeros(), zeros(N_FEATURES)
        """mean action, before it was cut off to [-1, 1], value and features of the last decision"""

    @torch.no_grad()
    def decide(self, obs: Tensor) -> AgentDecision:
        self._obs[:] = obs
        due = self._due()
        if len(due):
            row = self._obs[due], self._last_obs[due], self._last_action[due], self._age[due] > 0
            for held, found in zip(self._said, by_chunk(self._one, *row), strict=True):
                held[due] = found
        mean, value, features = (part.clone() for part in self._said)
        self.decision = AgentDecision(mean.clamp(-1.0, 1.0), value, self.policy.log_std.exp(), *features.T)
        return self.decision

    def advance(self) -> None:
        due = self._due()
        self._last_obs[due], self._last_action[due] = self._obs[due], self._said[0][due]
        super().advance()


def by_chunk(function: Callable[..., tuple[Tensor, ...]], *inputs: Tensor) -> list[Tensor]:
    """Outputs of a function, ``CHUNK`` rows at a time, the last chunk filled up with its first row."""
    parts = []
    for i in range(0, len(inputs[0]), CHUNK):
        chunk = [tensor[i : i + CHUNK] for tensor in inputs]
        missing = CHUNK - len(chunk[0])
        parts.append(function(*(torch.cat([t, t[:1].expand(missing, *t.shape[1:])]) for t in chunk)))
    return [torch.cat(found)[: len(inputs[0])] for found in zip(*parts, strict=True)]


_NO_NETWORK = {
    "forecast": "forecasts and does not drive; give it to an agent that does: --set forecast.learned=RUN",
    "search": "numbers of the behavior tree, no network; they drive by --agent with the run's stack.yaml",
    "set": "a policy over a set of obstacles looks at the simulator itself; give it to 'uuv eval'",
}
"""what cannot be a ``PolicyAgent``, by ``LearningConfig.learner``, or ``encoder`` of a policy"""


def load_agent(checkpoint: Checkpoint, num_envs: int, device: Device = "cpu") -> PolicyAgent:
    """PolicyAgent of a checkpoint. Raises CheckpointError where its networks do not fit its config."""
    config = checkpoint.config
    kind = config.encoder if config.learner == "ppo" else config.learner
    if kind in _NO_NETWORK:
        raise CheckpointError(f"{checkpoint.path}: {_NO_NETWORK[kind]}")

    def n_obs() -> int:
        return max(row["stop"] for row in checkpoint.manifest.observation_table)

    new, world, world_model = torch.Generator(), config.world_model, None
    policy = network(checkpoint, "policy", lambda: ActorCritic(n_obs() + N_FEATURES, config.policy, new))
    if world.enabled and world.as_features:
        world_model = network(checkpoint, "world_model", lambda: WorldModel(n_obs(), world, new)).to(device)
    return PolicyAgent(policy.to(device), world_model, num_envs, device)


Net = TypeVar("Net", bound=nn.Module)


def network(checkpoint: Checkpoint, name: str, make: Callable[[], Net]) -> Net:
    """What ``make`` gives, with the weights that a checkpoint holds under this name. Raises CheckpointError
    where they are of another shape, before anything is made so wide, or not finite."""
    model = checkpoint.model()
    with refused(checkpoint.path / MODEL, "its networks are not those of its config"):
        part = model[name]
        with torch.device("meta"):  # shapes alone
            expected = make().state_dict()
        if part.keys() != expected.keys():
            raise ValueError(f"{name} holds other tensors: {min(part.keys() ^ expected.keys())}")
        for key, like in expected.items():
            if part[key].shape != like.shape:
                raise ValueError(f"{name}.{key} is {tuple(part[key].shape)} instead of {tuple(like.shape)}")
            if not bool(torch.isfinite(part[key]).all()):
                raise FileError(f"{key} is not finite: the training failed; take an older checkpoint")
        net = make()
        net.load_state_dict(part)
    return net.eval()
