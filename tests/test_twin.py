"""The kinematic twin: bodies on their paths, the rule that lays a wish on the hull, the set encoder."""

import math

import numpy as np
import pytest
import taichi as ti
import torch

from uuvtai.config import TankConfig
from uuvtai.kernels.core.hull import hull_to_side_wall
from uuvtai.kernels.core.signature import AnyTensor as Tensor3
from uuvtai.kernels.core.signature import FloatMatrix as Tensor2
from uuvtai.outcomes import RUNNING
from uuvtai.twin import motion
from uuvtai.twin.scenario_bank import bank_of
from uuvtai.twin.set_policy import SetActor
from uuvtai.twin.tensors import AXIS_M_S, BODY_COLUMNS, CLIMB_M_S, EGO_COLUMNS, MARGIN_M, MOVERS, N_EGO


def laid(wish, yaw, z, tank):
    """Oracle of the hull rule, in parts of the limits."""
    surge = math.cos(yaw) * wish[0] + math.sin(yaw) * wish[1]
    sway = math.cos(yaw) * wish[1] - math.sin(yaw) * wish[0]
    over = max(1.0, abs(surge) / AXIS_M_S, abs(sway) / AXIS_M_S)
    diagonals = [yaw + math.pi / 4 + i * math.pi / 2 for i in range(4)]
    way = math.atan2(wish[1], wish[0])
    off = min((math.remainder(way - d, 2 * math.pi) for d in diagonals), key=abs)
    turn = off if math.hypot(wish[0], wish[1]) > 0.1 else 0.0
    low, high = min(tank.z_m[0] + MARGIN_M - z, 0.0), max(tank.z_m[1] - MARGIN_M - z, 0.0)
    heave = min(max(wish[2], low), high)
    return (
        surge / over / AXIS_M_S,
        sway / over / AXIS_M_S,
        np.clip(heave / CLIMB_M_S, -1, 1),
        np.clip(2.5 * turn, -1, 1),
    )


def test_a_wish_is_laid_on_the_hull_as_the_oracle_lays_it():
    tank, draw = TankConfig(), np.random.default_rng(0)
    ego = np.stack([draw.uniform(-7, 7, 200), draw.uniform(*tank.z_m, 200)], 1).astype(np.float32)
    wish = draw.uniform(-0.9, 0.9, (200, 3)).astype(np.float32)
    wish[:20, :2] *= 0.01
    out = torch.zeros(200, 4)
    motion.command_of(torch.from_numpy(ego), torch.from_numpy(wish), out, tank)
    wanted = [laid(w, e[0], e[1], tank) for w, e in zip(wish.tolist(), ego.tolist(), strict=True)]
    assert out.numpy() == pytest.approx(np.array(wanted), abs=2e-5)
    assert out.abs().max() <= 1.0 + 1e-6


def test_the_order_of_the_bodies_means_nothing():
    draw = torch.Generator().manual_seed(0)
    body, row = (
        torch.randn(5, MOVERS, BODY_COLUMNS, generator=draw),
        torch.randn(5, EGO_COLUMNS, generator=draw),
    )
    body[..., 0] = (body[..., 0] > 0).float()
    actor = SetActor()
    actor.net.out.weight.data.mul_(100.0)
    order = torch.randperm(MOVERS, generator=draw)
    assert torch.allclose(actor(body, row), actor(body[:, order], row), atol=1e-5)


def test_the_policy_has_no_input_for_the_truth():
    names = dict(SetActor().named_parameters())
    assert names["net.body.0.weight"].shape[1] == BODY_COLUMNS
    assert names["net.own.0.weight"].shape[1] == EGO_COLUMNS
    assert not any("critic" in name for name in names)


@ti.kernel
def referee_of(
    static: Tensor3, mover: Tensor3, ego: Tensor2, bodies: Tensor3, found: Tensor2, cfg: ti.template()
):
    """The twin's bodies (x, y) and its referee's clearance and time to collision, at a time and a motion."""
    for env in range(ego.shape[0]):
        for lane in range(bodies.shape[1]):
            at = motion.body_on_path(mover, env, lane, ego[env, 8])
            bodies[env, lane, 0], bodies[env, lane, 1] = at[0], at[1]
        pos, vel = (
            ti.Vector([ego[env, 0], ego[env, 1], ego[env, 2]]),
            ti.Vector([ego[env, 3], ego[env, 4], ego[env, 5]]),
        )
        axis = ti.Vector([ti.cos(ego[env, 6]), ti.sin(ego[env, 6]), 0.0])
        near = motion.nearest_of(
            pos, axis, vel, ego[env, 7], env, ego[env, 8], static, mover, cfg.episode.ttc_closing_m_s,
            cfg.vehicle,
        )  # fmt: skip
        wall = hull_to_side_wall(pos, axis, cfg.vehicle, cfg.world.tank)
        found[env, 0], found[env, 1] = ti.min(near[0], wall), near[1]


def test_bodies_and_referee_are_those_of_the_simulator(small):
    """The same scenarios, forty steps later: the twin's referee, told the simulator's motion."""
    sim, steps = small.sim, 40
    small.begin(range(small.N), seed=3)
    bank = bank_of(sim)
    for _ in range(steps):
        sim.step()
    s, running = sim.s, sim.rows(sim.s.referee.outcome) == RUNNING
    ego = torch.zeros(small.N, N_EGO)
    rotation_yaw = sim.rows(s.vehicle.quat_wb)
    w, x, y, z = rotation_yaw.T
    ego[:, 0:3] = torch.from_numpy(sim.rows(s.vehicle.pos_w))
    ego[:, 6] = torch.from_numpy(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    ego[:, 8] = steps * small.config.episode.control_dt_s
    bodies, found = torch.zeros(small.N, MOVERS, 2), torch.zeros(small.N, 2)
    referee_of(bank.static, bank.mover, ego, bodies, found, small.config)
    kind, place = sim.rows(s.world.kind), sim.rows(s.world.pos_w)
    lanes = s.path.n_way.shape[1]
    first = kind.shape[1] - lanes
    moving = kind[:, first:] != 0
    assert running.sum() >= 4 and moving.any()
    mine = bodies.numpy()[:, :lanes][running][moving[running]]
    assert mine == pytest.approx(place[running, first:][moving[running]][:, :2], abs=2e-3)
    near = sim.rows(s.referee.clearance_m)[running]
    seen = found.numpy()[running, 0]
    assert (near < 1.0).any(), "nothing is near"
    assert seen[near < 1.0] == pytest.approx(near[near < 1.0], abs=5e-3)
