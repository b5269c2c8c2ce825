"""The small simulator for every test of the whole stack; ``tests/warm.py`` compiles it before they begin."""

import torch


def sim_with_one_beam():
    """A simulator of one vehicle with a mechanical sonar; ``tests/warm.py`` compiles it beforehand too."""
    from uuvtai.config.loader import load_config
    from uuvtai.sim.behavior_tree import read_tree
    from uuvtai.sim.sim import Sim

    return Sim(load_config("pool", "ping360"), 1, read_tree("bt"))


class SmallSim:
    """A simulator whose kernels are compiled once for the session, and what tests do with it."""

    N = 8
    CHANGES = {"world.dynamic_capacity": 9}
    OPTIONS = ("--num-envs", "8", "--set", "world.dynamic_capacity=9", "--device", "cpu")
    """of commands in processes of their own that are to find these kernels compiled (``tests/warm.py``
    compiles them beforehand)"""
    TRAIN = (
        "train", "smoke", *OPTIONS[2:], "--set", "train.num_envs=8", "--set", "episode.horizon_steps=400",
        "--set", "distillation.batch=32", "--set", "world_model.batch=32",
    )  # fmt: skip

    def __init__(self, sensors="paper"):
        from uuvtai.config.loader import load_config
        from uuvtai.sim.behavior_tree import read_tree
        from uuvtai.sim.sim import Sim

        self.config = load_config("pool", sensors, overrides=self.CHANGES)
        self.trees = {name: read_tree(name) for name in ("straight", "planner", "bt")}
        self.sim = Sim(self.config, self.N, self.trees["bt"])
        self.new = self.sim.memory().read().copy()

    def forget(self):
        """As it was built."""
        self.sim.memory().read()[:] = self.new
        self.sim.tree, self.sim.observation = self.trees["bt"], None

    def begin(self, episodes, seed=0, rows=None):
        """Reset ``rows`` (default: the first ones) to these episode numbers."""
        rows = list(range(len(episodes))) if rows is None else rows
        mask, seeds, numbers = (torch.zeros(self.N, dtype=torch.int32) for _ in range(3))
        for row, number in zip(rows, episodes, strict=True):
            mask[row], seeds[row], numbers[row] = 1, seed, number
        self.sim.reset(mask, seeds, numbers)

    def begin_late(self, patch, steps):
        """Have every episode begin so many steps before its horizon."""
        begin, clock = self.sim.reset, self.sim.memory().live(self.sim.s.clock.step)

        def reset(mask, seed, number):
            begin(mask, seed, number)
            clock[mask.numpy() == 1] = self.config.episode.horizon_steps - steps

        patch.setattr(self.sim, "reset", reset)

    def scenario_bank(self):
        """The scenarios of episodes 0 .. N - 1 of seed 5, for the surrogate."""
        from uuvtai.surrogate.world import ScenarioBank, scenario_rows

        self.begin(range(self.N), seed=5)
        rows = [torch.from_numpy(rows.copy()) for rows in scenario_rows(self.sim)]
        return ScenarioBank(*rows, torch.zeros(self.N, dtype=torch.int32), ("pool",))

    def arrays(self, *nouns):
        """NumPy copies of every array of these structs but scratch, by 'struct.field'."""
        memory = self.sim.memory()
        views = memory.views(memory.read())
        return {name: view.copy() for name, view in views.items() if name.partition(".")[0] in nouns}
