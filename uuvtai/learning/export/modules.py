"""What is exported of a checkpoint: networks without memory, their weights as plain arrays, golden pairs, and
policy_spec.json, which says what every column is."""

from __future__ import annotations

import io
import math
import warnings
from typing import Any

import torch
from torch import Tensor, nn

from uuvtai.common import enums
from uuvtai.common.enums import EGO_COLUMNS, N_OBSTACLE, N_RAY, OBSTACLE_WIDTH
from uuvtai.common.version import __version__
from uuvtai.config.learning import LearningConfig
from uuvtai.learning.checkpoint import Checkpoint, action_rows
from uuvtai.learning.export.graph import without_telemetry
from uuvtai.learning.export.run_policy import GOLDEN, SCHEMA, TOLERANCE, WEIGHTS, Arrays
from uuvtai.learning.networks import NUM_ACTIONS
from uuvtai.learning.policy_agent import OneDecision, load_agent
from uuvtai.learning.set_networks import SetActor, actor_of
from uuvtai.learning.world_model import N_FEATURES, N_TARGET

ONNX = "policy.onnx"
OPSET = 20
NO_LIMIT = float(torch.finfo(torch.float32).max)
"""of a normaliser that has seen nothing and therefore cuts nothing off"""
_ROWS, _SEED = 64, 6

_OBSERVATION = (
    "float32, raw SI units, in this order; not finite = the mean of training. Frames: body (x ahead, y left, "
    "z up); level, the same without roll and pitch; route, along the planned path; world, z 0 at the surface."
)
_ACTION = "parts of the limits within [-1, 1]; body velocities, wanted of the inner velocity loop"
_HOLD = (
    "The networks decide at the first control step of a mission and then at every hold_steps-th one; in "
    "between the action is held, cut off to [-1, 1]."
)
_WISH = (
    "ahead, left, up in the mirrored world: the first two in parts of fastest_m_s, shortened to length 1, "
    "the third in parts of the heave limit; held until the next decision"
)


class OneAction(OneDecision):
    """One decision of a policy on observation vectors; whoever calls it remembers the last one."""

    kind = "mlp"
    """one of ``run_policy.KINDS``; below, what goes in and out, in the order of ``forward``"""
    inputs = {
        "obs": "(N, n_obs) float32: the newest observation, raw SI units",
        "last_obs": "(N, n_obs) float32: that of the last decision; anything where has_last is false",
        "last_action": "(N, 4) float32: mean action of the last decision",
        "has_last": "(N,) bool: there was a decision before in this mission",
    }
    outputs = {
        "mean_action": "(N, 4) float32: mean action, not yet cut off to [-1, 1]",
        "value": "(N,) float32: expected return",
        "features": "(N, 2) float32: residual and uncertainty of the world model's last prediction",
    }

    def rows(self, count: int, rng: torch.Generator) -> tuple[Tensor, ...]:
        """Made-up inputs, spread as training had them."""
        norm, n_obs = self.policy.observation_norm, self.policy.n_in - N_FEATURES
        mean, std = norm.mean[:n_obs].float(), norm.std()[:n_obs].float()
        last, obs = (mean + std * torch.randn(count, n_obs, generator=rng) for _ in range(2))
        if self.world_model is not None:  # a step later little has changed
            step = 0.1 * std[:N_TARGET] * torch.randn(count, N_TARGET, generator=rng)
            obs[:, :N_TARGET] = last[:, :N_TARGET] + step
        for row, column, bad in ((0, 0, math.nan), (1, -1, math.inf), (1, n_obs // 2, -math.inf)):
            obs[row, column], last[-1 - row, column] = bad, bad
        action = torch.randn(count, NUM_ACTIONS, generator=rng)
        return obs, last, action, torch.arange(count) > 0

    def weights(self) -> dict[str, Tensor]:
        """Arrays of ``policy.safetensors`` by the names that ``run_policy.py`` knows."""
        policy, world = self.policy, self.world_model
        norms = {"norm": policy.observation_norm}
        nets = {"actor": policy.actor, "critic": policy.critic}
        if world is not None:
            norms["world_norm"] = world.observation_norm
            nets |= {"encoder": world.encoder, "dynamics": world.dynamics, "decoder": world.decoder}
        found = {"value.mean": policy.value_norm.mean, "value.std": policy.value_norm.std()}
        for name, norm in norms.items():
            limit = torch.tensor([norm.clip if float(norm.count) > 0 else NO_LIMIT])
            found |= {f"{name}.mean": norm.mean, f"{name}.scale": 1.0 / norm.std(), f"{name}.limit": limit}
        for name, net in nets.items():
            found |= {f"{name}.{key}": tensor for key, tensor in net.state_dict().items()}
        return found

    def about(self, checkpoint: Checkpoint) -> dict[str, Any]:
        """Entries of policy_spec.json that only this kind has."""
        policy, norm = self.policy, self.policy.observation_norm
        pairs = zip(norm.mean.tolist(), norm.std().tolist(), strict=True)
        scales = [{"mean": mean, "std": std} for mean, std in pairs]
        columns = []
        for row in checkpoint.manifest.observation_table:
            first, stop = row["first"], row["stop"]
            for at in range(first, stop):
                name = row["name"] if stop - first == 1 else f"{row['name']}[{at - first}]"
                about = {"index": at, "name": name, "unit": row["unit"], "frame": row["frame"]}
                columns.append(about | scales[at])
        used = {"unit": "1", "used": self.world_model is not None}
        features = zip(("residual", "uncertainty"), scales[-N_FEATURES:], strict=True)
        return {
            "observation": {"width": policy.n_in - N_FEATURES, "meaning": _OBSERVATION, "columns": columns},
            "features": [{"name": name, **used, **scale} for name, scale in features],
            "action": checkpoint.manifest.action,
            "action_meaning": _ACTION,
            "rate": _rate(checkpoint.config) | {"meaning": _HOLD},
            "network": {"hidden": list(policy.config.hidden), "activation": policy.config.activation},
        }


class OneWish(nn.Module):
    """One decision of a policy over a set of obstacles."""

    kind = "set"
    inputs = {
        "obstacles": f"(N, n, {OBSTACLE_WIDTH}) float32: moving obstacles in any order; zeros = none",
        "own": f"(N, {EGO_COLUMNS}) float32: the vehicle, its goal and the free distances around it",
    }
    outputs = {"mean_wish": "(N, 3) float32: ahead, left, up in the mirrored world; cut to [-2, 2], filter"}

    def __init__(self, actor: SetActor) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, obstacles: Tensor, own: Tensor) -> tuple[Tensor, ...]:
        return (self.actor(obstacles, own),)

    def rows(self, count: int, rng: torch.Generator) -> tuple[Tensor, ...]:
        obstacles = torch.randn(count, N_OBSTACLE, OBSTACLE_WIDTH, generator=rng)
        own = torch.randn(count, EGO_COLUMNS, generator=rng)
        number = torch.randint(1, N_OBSTACLE + 1, (count,), generator=rng)
        number[0] = 0
        there = torch.arange(N_OBSTACLE) < number[:, None]
        obstacles *= there[..., None]
        obstacles[..., 0] = there.float()
        return obstacles, own

    def weights(self) -> dict[str, Tensor]:
        return {f"actor.{name}": tensor for name, tensor in self.actor.net.state_dict().items()}

    def about(self, checkpoint: Checkpoint) -> dict[str, Any]:
        config = checkpoint.config
        obstacles = {"most": N_OBSTACLE, "columns": OBSTACLE_COLUMNS}
        return {
            "observation": {"meaning": MEANING, "obstacles": obstacles, "own": {"columns": OWN_COLUMNS}},
            "action": {"columns": ["ahead", "left", "up"], "meaning": _WISH},
            "rate": _rate(config),
            "hull_rule": hull_rule_of(config),
            "safety": safety_of(config),
            "network": {"goal_gain": config.surrogate.goal_gain},
        }


ExportedModule = OneAction | OneWish
"""networks without memory: rows of inputs to rows of outputs"""


@torch.inference_mode()
def said(module: ExportedModule, rows: Arrays) -> Arrays:
    """Outputs by name for rows of inputs by name."""
    found = module(*(torch.from_numpy(part) for part in rows.values()))
    return {name: part.numpy() for name, part in zip(module.outputs, found, strict=True)}


def module_of(checkpoint: Checkpoint) -> ExportedModule:
    """What of a checkpoint drives. Raises CheckpointError where nothing does."""
    if checkpoint.config.learner == "ppo" and checkpoint.config.encoder == "set":
        return OneWish(actor_of(checkpoint)).eval()
    agent = load_agent(checkpoint, 1)
    return OneAction(agent.policy, agent.world_model).eval()


def weights_of(module: ExportedModule) -> dict[str, Tensor]:
    """Arrays by name, float32, on the host, contiguous."""
    found = module.weights().items()
    return {name: tensor.detach().float().cpu().contiguous().clone() for name, tensor in found}


def golden_of(module: ExportedModule) -> Arrays:
    """``pair_<input>`` and ``pair_<output>``: made-up inputs and what the module says to them."""
    made_up = module.rows(_ROWS, torch.Generator().manual_seed(_SEED))
    inputs = {name: tensor.numpy() for name, tensor in zip(module.inputs, made_up, strict=True)}
    return {f"pair_{name}": array for name, array in (inputs | said(module, inputs)).items()}


def onnx_bytes(module: ExportedModule) -> bytes:
    """The ONNX graph with its weights inside, any number of rows at once; without ``missing_packages``."""
    without_telemetry()
    names = [*module.inputs, *module.outputs]
    sizes = {name: {0: "rows"} | ({1: "obstacles"} if name == "obstacles" else {}) for name in names}
    made_up, graph = module.rows(2, torch.Generator().manual_seed(_SEED)), io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # the tracing exporter: ours have no branches, and the newer one takes twelve seconds to import
        torch.onnx.export(
            module, made_up, graph,  # type: ignore[arg-type]
            input_names=list(module.inputs), output_names=list(module.outputs),
            dynamic_axes=sizes, opset_version=OPSET, dynamo=False,
        )  # fmt: skip
    return graph.getvalue()


def specification(
    checkpoint: Checkpoint, module: ExportedModule, name: str, has_onnx: bool
) -> dict[str, Any]:
    """policy_spec.json without ``files``, which ``export`` adds."""
    graph = {"file": ONNX, "opset": OPSET, "inputs": module.inputs, "outputs": module.outputs}
    made = checkpoint.manifest.created
    return {
        "schema": SCHEMA,
        "kind": module.kind,
        "name": name,
        "uuvtai": __version__,
        "checkpoint": {"sha256": checkpoint.sha256, "step": checkpoint.step, "created": made},
        **module.about(checkpoint),
        "graph": graph if has_onnx else None,
        "golden": {"file": GOLDEN, "tolerance": TOLERANCE},
        "weights": WEIGHTS,
    }


def _rate(config: LearningConfig) -> dict[str, Any]:
    dt_s, hold = config.episode.control_dt_s, config.policy.hold_steps
    hertz = 1.0 / dt_s
    return {"control_dt_s": dt_s, "control_hz": hertz, "hold_steps": hold, "decision_hz": hertz / hold}


def hull_rule_of(config: LearningConfig) -> dict[str, Any]:
    """Numbers of the rule that lays a wish on the hull (``run_policy.SetPolicy.command``)."""
    vehicle, limits = config.vehicle, {row["name"]: row["limit"] for row in action_rows(config)[:3]}
    return {
        "fastest_m_s": math.hypot(vehicle.max_surge_m_s, vehicle.max_sway_m_s),
        "limits_m_s": limits,
        "max_yaw_rate_rad_s": vehicle.max_yaw_rate_rad_s,
        "turn_gain_1_s": enums.TURN_GAIN,
        "least_speed_m_s": enums.LEAST_SPEED_M_S,
        "z_m": list(config.world.tank.z_m),
        "gap_m": config.surrogate.vertical_gap_m,
    }


def safety_of(config: LearningConfig) -> dict[str, Any]:
    """Numbers of the safety filter (``run_policy.SetPolicy.kept_safe``)."""
    known = {name.lower(): value for name, value in vars(enums.Safety).items() if name.isupper()}
    return {"horizon_s": config.surrogate.safety_horizon_s, "ttc_s": config.episode.ttc_s, **known}


# ------------------------------------------------------------------------------------------------------------
# Columns of a policy over a set of obstacles, in words (``surrogate/observation.py`` writes them).


MEANING = (
    "float32. Mirrored world: x is turned round where the goal lies at smaller x than the start, y where it "
    "lies at smaller y (flip is -1 there, else 1), by the start of a mission. Each column is the quantity in "
    "its unit; clip(v, a, b) cuts off to [a, b]. An obstacle is a tracked moving one; a row of zeros is "
    "none. Numbers that are not finite are refused."
)


def _columns(table: str) -> list[dict[str, str]]:
    """Rows of "names | unit | meaning"."""
    rows = [line.split(" | ") for line in table.strip().splitlines()]
    return [{"name": name, "unit": u, "meaning": told} for names, u, told in rows for name in names.split()]


OBSTACLE_COLUMNS = _columns("""
there | 1 | 1 = an obstacle
way.x way.y | 4 m | from the vehicle to the obstacle, in metres, / 4
relative_velocity.x relative_velocity.y | m/s | the obstacle's less the vehicle's
velocity.x velocity.y | m/s | of the obstacle
width | m | twice its radius
water_above | m | free water from the vehicle's depth up to an obstacle that is above: clip(v, 0, 1.6)
water_below | m | the same below; both are 0 where the obstacle may be level with the vehicle
unseen | 2 s | seconds since it was seen, at most 4, / 2
turn | 2 rad/s | rate of its course, mirrored by flip.x flip.y, clip(v, -3, 3) / 2; 0 = a corner
way_in_1s.x way_in_1s.y | 4 m | from the vehicle now to where the obstacle is forecast in 1 s, / 4
way_in_2s.x way_in_2s.y | 4 m | the same in 2 s
gap | 4 m | distance less the obstacle's radius, at most 8 m, / 4
nearness | 1/m | 1 / (0.3 + max(distance - radius - 0.22, 0))
closest_in | s | time of the closest approach on straight lines, clip(v, 0, 3)
closest_gap | m | distance then, less radius and 0.22, clip(v, -1, 3)
route_direction.x route_direction.y | 1 | unit vector to the look-ahead point of the route
""")
OWN_COLUMNS = _columns(
    """
goal.x | 10 m | from the vehicle to the goal, / 10
goal.y | 4 m | the same, / 4
goal.z | m | height of the goal above the vehicle
route_direction.x route_direction.y | 1 | unit vector to the look-ahead point, or to the goal
goal_distance | 4 m | horizontal, at most 4 m, / 4
speed.x speed.y | m/s | of the vehicle
heave | 0.5 m/s | upward velocity in the body frame, x 2
height | m | z + 0.8, z = 0 at the surface
last_wish.x last_wish.y last_wish.z | 1 | carried out last: x and y shortened to length 1, \
z within +-1; 0 at the start
cos_4_yaw | 1 | cosine of four times the heading
sin_4_yaw | 1 | its sine, times flip.x flip.y
across | 3 m | flip.y (y - 3) / 3, y in the tank
along | 10 m | flip.x (x - 10) / 10, x in the tank
goal_direction.x goal_direction.y | 1 | unit vector to the goal
route_distance | m | horizontal, to the look-ahead point, at most 2 m
route_left | 10 m | length of the route to the goal, / 10
route_aside | m | place left of the route, times flip.x flip.y, clip(v, -2, 2)
"""
    + "\n".join(
        f"ray[{i}] | 1/m | 1 / (0.3 + clip(free - 0.22, 0, 4)) - 0.5, free metres to the nearest wall or "
        f"occupied cell (at most 4.3) at {360 * i / N_RAY:g} degrees from x towards y"
        for i in range(N_RAY)
    )
)
