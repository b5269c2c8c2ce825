"""An environment that follows a script and keeps what it was told: what is learnt can be worked out."""

from typing import NamedTuple

import torch

from uuvtai.envs.vector_env import ObservationColumn

N_TARGET = 24
"""columns that the world model predicts; column 24 says which moment it is"""
JUMP = 100.0
"""between the observations of two episodes: a transition across their border would be seen"""


class Moment(NamedTuple):
    """One control step of all envs, (N, ...)."""

    obs: torch.Tensor
    behavior: torch.Tensor
    action: torch.Tensor
    """as it was handed to ``step``"""
    final_obs: torch.Tensor
    reward: torch.Tensor
    terminated: torch.Tensor
    ended: torch.Tensor


class ScriptedEnv:
    """With the interface of ``VectorEnv``.

    Every target column follows one command of the action, a tenth of it in each step. The tree's action, the
    reward and the endings follow the script and depend on nothing that is done.
    """

    num_actions, num_obs = 4, N_TARGET + 1
    node_names = ("Root",)
    outcomes = ("running", "success", "collision", "ttc", "out_of_tank", "timeout")
    reward_terms = ("script",)

    def __init__(self, script):
        """``script``: per env the steps of its episodes and how each ends; after the last it goes on."""
        self.script, self.num_envs, self.device = script, len(script), torch.device("cpu")
        self.observation_table = (
            ObservationColumn("targets", slice(0, N_TARGET), "1", "none", "follow the action"),
            ObservationColumn("moment", slice(N_TARGET, N_TARGET + 1), "1", "none", "running number"),
        )
        self.log = []
        """every ``Moment`` since the reset"""

    def reset(self, seed=None):
        n = self.num_envs
        self._targets = torch.sin(torch.arange(n * N_TARGET).float()).view(n, N_TARGET)
        self._episode, self._age = torch.zeros(n, dtype=torch.int64), torch.zeros(n, dtype=torch.int64)
        self._t = 0
        self.log.clear()
        return self._obs(), self._info() | {
            "outcome": torch.zeros(n, dtype=torch.int32),
            "reward_terms": torch.zeros(n, 1),
        }

    def step(self, action):
        obs, behavior = self._obs(), self._info()["teacher_action"]
        self._targets = self._targets + 0.1 * action.clamp(-1, 1).repeat(1, N_TARGET // 4)
        self._age += 1
        self._t += 1
        outcome = torch.tensor([self._due(env) for env in range(self.num_envs)], dtype=torch.int32)
        ended, truncated = outcome > 0, outcome == self.outcomes.index("timeout")
        reward = torch.cos(3.0 * self._t + torch.arange(self.num_envs)) + 2.0 * (
            outcome == self.outcomes.index("success")
        )
        self.log.append(Moment(obs, behavior, action.clone(), self._obs(), reward, ended & ~truncated, ended))
        final = {"final_obs": self._obs(), "episode_return": reward, "episode_steps": self._age.clone()}
        self._episode += ended
        self._age[ended] = 0
        self._targets = self._targets + JUMP * ended[:, None]
        return (
            self._obs(),
            reward.clone(),
            ended & ~truncated,
            truncated,
            self._info() | final | {"outcome": outcome, "reward_terms": reward[:, None]},
        )

    def _due(self, env):
        """Index of how the episode of this env ends now, 0 where it goes on."""
        episodes, episode = self.script[env], int(self._episode[env])
        ends = episode < len(episodes) and episodes[episode][0] == int(self._age[env])
        return self.outcomes.index(episodes[episode][1]) if ends else 0

    def _obs(self):
        moment = 1000.0 * torch.arange(self.num_envs) + self._t
        return torch.cat([self._targets, moment[:, None]], 1)

    def _info(self):
        behavior = torch.sin(self._obs()[:, -1:] + torch.arange(4.0))
        zeros = torch.zeros(self.num_envs, dtype=torch.int32)
        return {"teacher_action": behavior, "leaf": zeros, "seed": zeros, "episode": self._episode.clone()}
