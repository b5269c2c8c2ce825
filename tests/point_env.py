"""A task without a simulator: points that must reach the origin, with ``VectorEnv``'s rules of resetting."""

import torch

from uuvtai.envs.vector_env import ObservationColumn

OUTCOMES = ("running", "success", "collision", "ttc", "out_of_tank", "timeout")
CONTROL_DT_S, GOAL_M, EDGE_M, HORIZON = 0.2, 0.3, 3.0, 60


class PointEnv:
    """Action (N, 4): velocity in x, y, two idle. The teacher heads home; its node 1 acts far, 2 near."""

    num_actions = 4
    num_obs = 24
    node_names = ("Root", "Far", "Near")
    outcomes = OUTCOMES
    reward_terms = ("progress", "effort")

    def __init__(self, num_envs=16, seed=0):
        self.num_envs, self.device, self._seed = num_envs, torch.device("cpu"), seed
        self.observation_table = (
            ObservationColumn("position", slice(0, 2), "m", "world", "of the point"),
            ObservationColumn("idle", slice(2, 24), "1", "none", "constant"),
        )
        self.poison = {}
        """tensors spoilt with NaN in row 1 after every step: 'obs', 'reward' or 'teacher_action'"""

    def reset(self, seed=None):
        self._seed = self._seed if seed is None else seed
        self._episode = torch.arange(self.num_envs)
        self._pos, self._steps = torch.zeros(self.num_envs, 2), torch.zeros(self.num_envs, dtype=torch.int32)
        self._return = torch.zeros(self.num_envs)
        self._begin(torch.ones(self.num_envs, dtype=torch.bool))
        self.info = {"final_obs": self._obs()}
        return self._obs(), self._tell(
            torch.zeros(self.num_envs, dtype=torch.int32), torch.zeros(self.num_envs, 2)
        )

    def step(self, action):
        before = self._pos.norm(dim=1)
        self._pos = self._pos + CONTROL_DT_S * action[:, :2].clamp(-1, 1)
        self._steps += 1
        distance = self._pos.norm(dim=1)
        success, out = distance < GOAL_M, distance > EDGE_M
        terms = torch.stack(
            [before - distance + 3.0 * success - 3.0 * out, -0.01 * action.square().sum(1)], 1
        )
        reward, terminated = terms.sum(1), success | out
        truncated = (self._steps >= HORIZON) & ~success & ~out
        self._return += reward
        outcome = torch.where(success, 1, torch.where(out, 4, torch.where(truncated, 5, 0))).to(torch.int32)
        self.info = {
            "final_obs": self._obs(),
            "episode_return": self._return.clone(),
            "episode_steps": self._steps.clone(),
        }
        self._begin(terminated | truncated, self.num_envs)
        obs, info = self._obs(), self._tell(outcome, terms)
        for name, tensor in {
            "obs": obs,
            "final_obs": info["final_obs"],
            "reward": reward,
            "teacher_action": info["teacher_action"],
        }.items():
            if name in self.poison:
                tensor[1] = float("nan")
        return obs, reward, terminated, truncated, info

    def capture(self):
        return {n: getattr(self, f"_{n}").numpy().copy() for n in ("pos", "steps", "return", "episode")} | {
            "seed": self._seed
        }

    def restore(self, arrays):
        for name in ("pos", "steps", "return", "episode"):
            setattr(self, f"_{name}", torch.as_tensor(arrays[name].copy()))
        self._seed = arrays["seed"]
        self.info = {"final_obs": self._obs()}
        return self._obs(), self._tell(
            torch.zeros(self.num_envs, dtype=torch.int32), torch.zeros(self.num_envs, 2)
        )

    def _begin(self, rows, ahead=0):
        self._episode += ahead * rows
        for row in rows.nonzero().flatten().tolist():
            draw = torch.Generator().manual_seed(100_000 * self._seed + int(self._episode[row]))
            self._pos[row] = 1.0 + torch.rand(2, generator=draw)
        self._steps = torch.where(rows, 0, self._steps)
        self._return = torch.where(rows, 0.0, self._return)

    def _obs(self):
        return torch.cat([self._pos, torch.ones(self.num_envs, 22)], 1)

    def _tell(self, outcome, terms):
        distance = self._pos.norm(dim=1, keepdim=True)
        behavior = torch.cat([-self._pos / distance.clamp(min=0.1), torch.zeros(self.num_envs, 2)], 1)
        leaf = torch.where(distance[:, 0] > 1.0, 1, 2).to(torch.int32)
        return self.info | {
            "teacher_action": behavior, "leaf": leaf, "outcome": outcome, "reward_terms": terms,
            "seed": self._seed * torch.ones_like(leaf), "episode": self._episode,
        }  # fmt: skip
