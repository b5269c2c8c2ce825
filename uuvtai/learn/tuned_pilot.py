"""The behaviour tree with numbers that were learnt: factors on its config's, row by row."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.manifest import MODEL, CheckpointError
from uuvtai.learn.pilot import PilotDecision
from uuvtai.tuned_numbers import FAST, SLOW, TUNED

if TYPE_CHECKING:
    from uuvtai.env import ObservationColumn
    from uuvtai.sim import Sim

_FEWEST = 25
"""numbers that a checkpoint holds; those that came later are not changed where it lacks them"""


class TunedPilot:
    """Lets the simulator's tree drive, with other numbers from the first decision after a reset on; used as
    ``Pilot`` is."""

    world_model = None

    def __init__(self, log_factor: torch.Tensor, sim: Sim) -> None:
        """``log_factor`` (n_tuned, 2) natural logarithms of the factors, in the order of ``TUNED``, for slow
        bodies and for fast ones."""
        self.simulator = sim
        rows = sim.s.teacher.tuned.shape[0]
        self.log_factor = log_factor.float().cpu().numpy()[None].repeat(rows, axis=0)
        """(rows, n_tuned, 2) of every row that is allocated"""
        nothing = torch.zeros(sim.num_envs, device=sim.device)
        std = torch.zeros(4, device=sim.device)
        self.decision = PilotDecision(sim.action, nothing, std, nothing, nothing)
        """value, residual and uncertainty are 0: nobody says them"""

    def reset(self, rows: torch.Tensor) -> None:
        """New episodes have begun in the rows (num_envs,) where this is not 0: a reset has set their numbers
        back."""
        self.simulator.put(self.simulator.s.teacher.tuned, self.log_factor)

    def decide(self, obs: torch.Tensor) -> PilotDecision:
        """What the tree has chosen; changes nothing."""
        self.decision = self.decision._replace(action=self.simulator.action.clone())
        return self.decision

    def advance(self) -> None:
        """The last decision has been carried out."""


def load_tuned(checkpoint: Checkpoint, sim: Sim) -> TunedPilot:
    """Pilot of a checkpoint that holds numbers of the tree. Raises CheckpointError for others."""
    return TunedPilot(checkpoint_factors(checkpoint), sim)


def checkpoint_factors(checkpoint: Checkpoint) -> torch.Tensor:
    """(n_tuned, 2) of a checkpoint. Raises CheckpointError where they are none that a training can leave."""
    try:
        found = checkpoint.model()["tree"]["log_factor"]
        known = len(found)
        if tuple(found.shape) != (known, 2) or not _FEWEST <= known <= len(TUNED):
            raise ValueError(f"log_factor is {tuple(found.shape)} instead of {(len(TUNED), 2)}")
        found = torch.cat([found, found.new_zeros(len(TUNED) - known, 2)])
        for number, factors in zip(TUNED, found.exp().tolist(), strict=True):
            for factor in factors:
                if not number.least * 0.999 <= factor <= number.most * 1.001:
                    raise ValueError(f"{number.name} is multiplied by {factor:g}")
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"{checkpoint.path / MODEL}: holds no numbers of the tree ({error}); take another one"
        ) from None
    return found


def tuned_sections(log_factor: torch.Tensor) -> dict[str, dict[str, float]]:
    """Sections ``slow`` and ``fast`` of the config by which a stack drives as these factors (n_tuned, 2) do,
    to four digits."""
    factors = np.exp(log_factor.double().numpy())
    return {
        section: {
            number.name: float(f"{factor:.4g}")
            for number, factor in zip(TUNED, factors[:, part], strict=True)
        }
        for section, part in (("slow", SLOW), ("fast", FAST))
    }


def tree_row() -> ObservationColumn:
    """The observation of such a pilot, for a checkpoint's manifest."""
    from uuvtai.env import ObservationColumn

    return ObservationColumn("tree", slice(0, 4), "1", "body", "what the behaviour tree asks for")
