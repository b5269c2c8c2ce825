"""The stack decides by observations alone: poisoned truth from tracking to the teacher changes no bit."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.conftest import configure, estimate_pose, launch_one_by_one
from uuvtai.common.enums import occupancy
from uuvtai.kernels.perception import height, localization
from uuvtai.kernels.planning import observation
from uuvtai.kernels.sensors import proprioception
from uuvtai.sim import stack
from uuvtai.sim.snapshot import capture
from uuvtai.sim.stages import SimState

KNOWN = {
    "clock", "mission", "ego", "scan", "echoes", "image", "localization", "tracks", "clusters", "spots",
    "turn_history",
    "forecast",
    "futures", "past", "mixture", "mask", "grid_map", "map_scratch",
    "clearance", "clearance_memory", "voronoi", "route", "observation", "behavior", "table", "baselines",
}  # fmt: skip
"""Structs of what the vehicle is told, senses, remembers and decides. Every other struct, a new one too,
counts as truth."""
TRUTH = {f.name for f in dataclasses.fields(SimState)} - KNOWN
STEPS, RESET_AT, RESET_ROWS = 60, 30, [2, 5]
POISON = 77
"""of whole numbers; NaN of the others"""


class Poison:
    """Spoils every truth array while it is ``on``; ``off`` puts back what was there."""

    def __init__(self, sim):
        memory = sim.memory()
        views = memory.views(memory.read(), scratch=True)
        self.arrays = {name: view for name, view in views.items() if name.partition(".")[0] in TRUTH}
        self.kept, self.written = {}, set()

    def on(self):
        self.kept = {name: view.copy() for name, view in self.arrays.items()}
        for view in self.arrays.values():
            view[...] = np.nan if view.dtype.kind == "f" else POISON

    def off(self):
        for name, view in self.arrays.items():
            if not (np.isnan(view) if view.dtype.kind == "f" else view == POISON).all():
                self.written.add(name)
            view[...] = self.kept[name]

    def during(self, sim, patch):
        """From now on be on from the first kernel of tracking to the last that writes the observation."""
        track, observe, planned_with = stack.track, stack.observe, sim._plan_seed
        predict, correct = localization.predict_pose, localization.correct_pose

        def poisoned(stage):
            """The pose filter runs before and after the sonar, which needs the truth."""

            def run(io):
                self.on()
                stage(io)
                self.off()

            return run

        def poisoned_track(io, config, privileged):
            self.on()
            track(io, config, privileged)

        def poisoned_observe(io, columns, out):
            observe(io, columns, out)
            self.off()

        def seed_of(env):
            """The fallback planner's random numbers come from the episode's key, which is no knowledge."""
            poisoned = int(self.arrays["episode.key"][env])
            self.arrays["episode.key"][env] = self.kept["episode.key"][env]
            seed = planned_with(env)
            self.arrays["episode.key"][env] = poisoned
            return seed

        patch.setattr(localization, "predict_pose", poisoned(predict))
        patch.setattr(localization, "correct_pose", poisoned(correct))
        patch.setattr(stack, "track", poisoned_track)
        patch.setattr(stack, "observe", poisoned_observe)
        patch.setattr(sim, "_plan_seed", seed_of)


@pytest.fixture
def watched(small, monkeypatch):
    """The session's simulator, writing observations with all columns: only their kernels are compiled."""
    launch_one_by_one(monkeypatch, small.sim)
    columns = small.config.observation.model_copy(update={"n_track": 4, "behavior": True})
    configure(monkeypatch, small.sim, small.config.model_copy(update={"observation": columns}))
    monkeypatch.setattr(
        small.sim, "observation", torch.zeros(small.N, observation.observation_width(columns))
    )
    memory = small.sim.memory()
    before = memory.read().copy()
    yield small
    memory.read()[:] = before  # scratch too: other tests never write that of the columns of obstacles


def driven(small, poison=None):
    """(actions, observations, arrays that a later step reads) of an episode per row, two begun anew."""
    with pytest.MonkeyPatch.context() as patch:
        if poison:
            poison.during(small.sim, patch)
        small.begin(range(small.N), seed=731971)
        actions, observations = [], []
        for step in range(STEPS):
            if step == RESET_AT:
                small.begin([40, 41], seed=731971, rows=RESET_ROWS)
            small.sim.step()
            actions.append(small.sim.action.clone())
            observations.append(small.sim.observation.clone())
        return torch.stack(actions), torch.stack(observations), capture(small.sim.memory())


def compared(small):
    """(undisturbed actions, what differs under poison, truth written between tracking and teacher)."""
    # slots beyond what is counted keep what an earlier episode left: both runs follow equal ones
    driven(small)
    actions, observations, arrays = driven(small)
    poison = Poison(small.sim)
    others = driven(small, poison)
    differing = [name for name in arrays if arrays[name].tobytes() != others[2][name].tobytes()]
    differing += ["action"] * (not torch.equal(actions, others[0])) + ["observation"] * (
        not torch.equal(observations, others[1])
    )
    assert actions.abs().mean() > 0.1 and observations.isfinite().all(), "they drive, and see something"
    assert arrays["tracks.moving"].any() and arrays["route.n_way"].all()
    assert occupancy(arrays["grid_map.static_occ"]).max() > 0.5
    return actions, differing, poison.written


def test_every_struct_is_known_or_truth():
    assert {f.name for f in dataclasses.fields(SimState)} >= KNOWN
    assert {
        "world", "vehicle", "params", "current", "path", "episode", "termination", "reward", "ego_memory",
        "sonar_memory",
    } <= TRUTH  # fmt: skip


def test_no_decision_observation_or_memory_depends_on_the_truth(watched):
    _, differing, written = compared(watched)
    assert differing == []
    assert written == set(), "truth belongs to the simulator: nobody else writes it"


def test_nor_with_an_estimated_pose_and_harsh_readings(watched, monkeypatch):
    """Position, heading and speed are off: whoever took the true ones would do something else."""
    exact, _, _ = driven(watched)
    estimate_pose(monkeypatch, watched)
    actions, differing, written = compared(watched)
    assert (differing, written) == ([], set())
    assert not torch.equal(actions, exact), "the readings are others"
    apart = np.abs(watched.sim.s.ego.pos_w.to_numpy() - watched.sim.s.vehicle.pos_w.to_numpy())
    assert apart.max() > 0.005
    assert (watched.sim.s.ego.z_var.to_numpy() > 0).all() and watched.sim.s.localization.mean.to_numpy().any()


# ----------------------------------------------------------------------------------- the tests above can fail


def test_the_poison_reaches_whoever_reads_the_truth(watched):
    sim = watched.sim
    watched.begin(range(watched.N))
    poison, s = Poison(sim), sim.s
    assert {name.partition(".")[0] for name in poison.arrays} == TRUTH
    s.clock.active.fill(1)
    before = s.ego.pos_w.to_numpy()
    poison.on()
    proprioception.sense_proprioception(sim.io.proprioception)
    sensed = {name: getattr(s.ego, name).to_numpy() for name in ("pos_w", "rate_b", "depth_m")}
    poison.off()
    assert np.isfinite(before).all() and all(np.isnan(values).all() for values in sensed.values())
    proprioception.sense_proprioception(sim.io.proprioception)
    assert np.array_equal(s.ego.pos_w.to_numpy(), before), "what was there is back"


def test_the_true_pose_in_place_of_the_estimate_is_found(watched, monkeypatch):
    """With exact sensors the estimate equals the truth: nothing but the poison tells them apart."""

    honest, leaking = (
        height.bound_heights,
        dataclasses.replace(watched.sim.io.tracking, ego=watched.sim.s.vehicle),
    )
    monkeypatch.setattr("uuvtai.sim.stack.height.bound_heights", lambda _io: honest(leaking))
    _, differing, _ = compared(watched)
    assert {"forecast.above_w", "observation"} & set(differing)
