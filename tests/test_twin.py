"""The kinematic twin: bodies on their paths, the rule that lays a wish on the hull, the set encoder."""

import math

import numpy as np
import pytest
import torch

from uuvtai.config import TankConfig
from uuvtai.twin import motion
from uuvtai.twin.set_policy import SetActor
from uuvtai.twin.tensors import AXIS_M_S, BODY_COLUMNS, CLIMB_M_S, EGO_COLUMNS, MARGIN_M, MOVERS


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
