"""Learn who shall drive: what ``learn/run.py`` drives where ``chooser.enabled``.

Every iteration plays episodes of one world and scene in the simulator, in which tree and policy take turns,
and fits the chance of arriving to what followed: what driving on for a moment is worth, if whoever is better
drives from then on (fitted Q iteration, Ernst, Geurts & Wehenkel 2005, JMLR 6; first to the ends alone).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from uuvtai.config.learning import LearningConfig
from uuvtai.errors import SettingError
from uuvtai.learn import checkpoint
from uuvtai.learn.arrival_net import ArrivalNet
from uuvtai.learn.chooser import ChooserPilot
from uuvtai.learn.chooser_memory import ChooserMemory, Tick, moments_of_episodes
from uuvtai.learn.distributed import Processes
from uuvtai.learn.episode_waves import play_episodes
from uuvtai.learn.optimiser import PlainAdamW
from uuvtai.learn.ppo import ADAM_EPS
from uuvtai.learn.rollout_sums import Recent, RolloutSums
from uuvtai.learn.set_pilot import SetPilot, set_pilot_of
from uuvtai.learn.world_sims import simulator_of
from uuvtai.outcomes import OUTCOMES, SUCCESS

if TYPE_CHECKING:
    from uuvtai.scenario import Scene
    from uuvtai.sim import Sim

_LEAST_RATE = 0.05
"""part of the learning rate that is left at the end"""


class ChooserTrainer:
    """Everything that learning to choose carries from one iteration to the next. Episodes begin and end
    within an iteration: the simulators carry nothing."""

    def __init__(self, config: LearningConfig, sims: Mapping[str, Sim] | None = None) -> None:
        """``sims``: simulators of worlds that are there already. Raises SettingError or CheckpointError for a
        policy that is none of the twin's."""
        from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS, N_BODY, TREE_WIDTH
        from uuvtai.twin.tree_columns import CHOOSER_TABLE

        self.config, self.processes = config, Processes()
        self.observation_table = CHOOSER_TABLE
        self._source = _policy_of(config)
        torch.set_flush_denormal(True)
        self.generator = torch.Generator().manual_seed(config.train.seed)
        self.net, self._slow = (
            ArrivalNet(BODY_WIDTH, EGO_COLUMNS, TREE_WIDTH, config, self.generator) for _ in range(2)
        )
        self._slow.load_state_dict(self.net.state_dict())
        self.optimiser = PlainAdamW(
            self.net.parameters(), lr=config.chooser.learning_rate, eps=ADAM_EPS, weight_decay=1e-3
        )
        self.memory = ChooserMemory(config.chooser.memory, N_BODY, BODY_WIDTH, EGO_COLUMNS + TREE_WIDTH)
        self.recent = Recent(OUTCOMES, ())
        self.iteration = self.env_steps = 0
        self._all_scenes: tuple[Scene, ...] = tuple(config.train.scenes) or (config.world.own_scene,)
        self._places: dict[str, tuple[Sim, SetPilot]] = {
            world: (sim, set_pilot_of(self._source, sim)) for world, sim in (sims or {}).items()
        }

    def iterate(self) -> dict[str, float]:
        """Play episodes, learn from the newest ones; metrics by their names in metrics.jsonl."""
        began = time.perf_counter()
        scenes = self._scenes()
        world, scene = scenes[self.iteration % len(scenes)]
        learner = _Learner(self, world)
        episodes = self.config.train.num_envs
        outcome, lasted = play_episodes(
            learner, scene, self.config.train.seed, self.iteration * episodes, episodes
        )
        steps = int(lasted.sum())
        self.memory.add(
            moments_of_episodes(learner.ticks, outcome == SUCCESS, self.config.chooser.look_ahead)
        )
        between = time.perf_counter()
        losses = [self._fit() for _ in range(self.config.chooser.minibatches)]
        learn_s = time.perf_counter() - between
        self.iteration += 1
        self.env_steps += steps
        return self._counted(outcome, steps) | {
            "train/value_loss": sum(losses) / len(losses),
            "train/learning_rate": self.optimiser.param_groups[0]["lr"],
            "time/simulate_s": between - began,
            "time/infer_s": 0.0,
            "time/learn_s": learn_s,
            "time/env_steps_per_s": steps / (between - began + learn_s),
            "time/env_steps": float(self.env_steps),
        }

    def _scenes(self) -> list[tuple[str, Scene]]:
        """Every world of ``chooser.worlds`` with every scene."""
        return [(name, scene) for scene in self._all_scenes for name in self.config.chooser.worlds]

    def place(self, world: str) -> tuple[Sim, SetPilot]:
        """The simulator of a world with the policy in it, made when it is first needed."""
        if world not in self._places:
            sim = simulator_of(self.config, world, self._all_scenes)
            self._places[world] = sim, set_pilot_of(self._source, sim)
        return self._places[world]

    def explores(self) -> float:
        """Share of the choices that are drawn now: all at first, then few."""
        done = self.iteration / self.config.train.iterations
        return 1.0 if done < self.config.chooser.warm_up else self.config.chooser.explore

    def _counted(self, outcome: torch.Tensor, steps: int) -> dict[str, float]:
        sums = RolloutSums.zeros(len(OUTCOMES), 0, torch.device("cpu"))
        sums.outcomes += torch.bincount(outcome, minlength=len(OUTCOMES)).double()
        sums.episode_steps += steps
        sums.samples += steps
        return self.recent.add(sums)

    def _fit(self) -> float:
        """One step of the networks towards what followed; the loss."""
        config, memory, rows = self.config.chooser, self.memory, self.memory.rows
        share = self.iteration / self.config.train.iterations
        self.optimiser.param_groups[0]["lr"] = config.learning_rate * max(_LEAST_RATE, 1.0 - share)
        at = memory.draw(config.minibatch, self.generator)
        arrived = rows.arrived[at].float()
        target = arrived.expand(config.networks, -1)
        if share >= config.ends_alone:
            after = memory.after(at)
            with torch.no_grad():
                later = self._slow.logits(rows.bodies[after].float(), rows.own[after].float()).sigmoid()
            target = torch.where(rows.ended[at] == 1, arrived, later.amax(-1))
        logits = self.net.logits(rows.bodies[at].float(), rows.own[at].float())
        said = logits.gather(2, rows.drives[at].long().expand(config.networks, -1)[..., None]).squeeze(2)
        loss = torch.nn.functional.binary_cross_entropy_with_logits(said, target)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
        self.optimiser.step()
        with torch.no_grad():
            for slow, fast in zip(self._slow.parameters(), self.net.parameters(), strict=True):
                slow.lerp_(fast, config.follow)
        return float(loss.detach())

    # --------------------------------------------------------------------------------------------- evaluation

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """``eval/*`` of the choice as it is, nothing drawn, on episodes that it never learnt from, the same
        number of each world and scene."""
        train, scenes = self.config.train, self._scenes()
        each = -(-train.evaluate_episodes // len(scenes))
        won, metrics = [], {}
        for world, scene in scenes:
            judge = _Judge(self, world)
            outcome, _ = play_episodes(judge, scene, train.evaluate_seed, 0, each)
            won.append((outcome == SUCCESS).float())
            metrics[f"eval/success_{Path(world).stem}_{scene[1]}_{scene[2]:g}"] = float(won[-1].mean())
        return metrics | {"eval/success_rate": float(torch.cat(won).mean())}

    # ------------------------------------------------------------------------------------------------- resume

    def state(self) -> dict[str, Any]:
        """All that the next iterations depend on. What drives are the parts ``policy`` and ``chooser``."""
        return {
            "policy": self._source.model()["policy"],
            "chooser": _copied(self.net),
            "slow": _copied(self._slow),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "recent": list(self.recent.rows),
            "counters": {
                "iteration": self.iteration,
                "env_steps": self.env_steps,
                "count": self.memory.count,
                "at": self.memory.at,
            },
            "env": self.memory.rows._asdict(),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        self.net.load_state_dict(state["chooser"])
        self._slow.load_state_dict(state["slow"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        self.recent.rows = [list(row) for row in state["recent"]]
        counters = state["counters"]
        self.iteration, self.env_steps = int(counters["iteration"]), int(counters["env_steps"])
        self.memory.count, self.memory.at = int(counters["count"]), int(counters["at"])
        for own, name in zip(self.memory.rows, self.memory.rows._fields, strict=True):
            own.copy_(state["env"][name])


class _Judge(ChooserPilot):
    """Chooses as in an evaluation, for a trainer's simulator."""

    def __init__(self, trainer: ChooserTrainer, world: str) -> None:
        sim, pilot = trainer.place(world)
        super().__init__(trainer.net, pilot, sim, trainer.config.chooser)
        self.running = torch.ones(sim.num_envs, dtype=torch.bool)
        """rows whose episode has not ended"""
        self.number = torch.zeros(sim.num_envs, dtype=torch.int64)
        """episode of every row"""


class _Learner(_Judge):
    """Draws who drives, wholly or now and then, and keeps what it saw."""

    def __init__(self, trainer: ChooserTrainer, world: str) -> None:
        super().__init__(trainer, world)
        self._generator, self._share = trainer.generator, trainer.explores()
        self._change = trainer.config.chooser.change
        self.ticks: list[Tick] = []

    def choose(
        self, rows: torch.Tensor, bodies: torch.Tensor, own: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """As ``ChooserPilot.choose``; a share of the rows does as chance says, for a while."""
        drives, chance = super().choose(rows, bodies, own)
        draw, coin = (torch.rand(len(rows), generator=self._generator) for _ in range(2))
        if self._share >= 1.0:
            begins = self._age[rows] == 0
            drives = torch.where(begins | (draw < self._change), coin < 0.5, self._drove[rows])
        else:
            drives = torch.where(draw < self._share, coin < 0.5, drives)
        kept = self.running[rows]
        if bool(kept.any()):
            self._keep(rows[kept], bodies[kept], own[kept], drives[kept])
        return drives, chance

    def _keep(
        self, rows: torch.Tensor, bodies: torch.Tensor, own: torch.Tensor, drives: torch.Tensor
    ) -> None:
        """A choice to learn from."""
        self.net.widen(bodies, own)
        self.ticks.append(Tick(self.number[rows], self._age[rows], bodies.half(), own.half(), drives))


def _copied(net: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in net.state_dict().items()}


def _policy_of(config: LearningConfig) -> checkpoint.Checkpoint:
    """The checkpoint that ``chooser.policy`` names. Raises SettingError for one that is no policy of the
    twin's."""
    if not config.chooser.policy:
        raise SettingError(
            "chooser.policy: names no policy; train one (uuv train twin --run-dir runs/twin), then: "
            "uuv train chooser --set chooser.policy=runs/twin"
        )
    path = Path(config.chooser.policy)
    found = checkpoint.best(path) if (path / "checkpoints").is_dir() else checkpoint.open_checkpoint(path)
    if not found.config.twin.enabled:
        raise SettingError(
            f"chooser.policy={path}: was not trained in the twin; train one: uuv train twin --run-dir {path}"
        )
    return found
