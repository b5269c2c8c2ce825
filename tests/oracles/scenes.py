"""Random scenes for the ray-casting sensors, and MuJoCo as an independent caster of them."""

import mujoco
import numpy as np

SPHERE, CYLINDER, BOX = 1, 2, 3
NOTHING_M = 1.0e6


def random_scenes(rng, n_env, n_obstacle, tank, tilt=0.5):
    """Scenes as float64 arrays that float32 holds exactly, vehicle outside every obstacle.

    pos, vel_b [n_env, 3], quat [n_env, 4]; kind, yaw [n_env, n_obstacle]; obstacle_pos, obstacle_vel, size
    [n_env, n_obstacle, 3]. A third of the obstacles spans the water column; kind 0 = empty slot. Obstacles
    may overlap each other, the walls, and the vehicle's column above or below it.
    """
    (x0, x1), (y0, y1), (z0, z1) = tank.x_m, tank.y_m, tank.z_m
    pos = rng.uniform(
        (x0 + 0.3 * (x1 - x0), y0 + 0.3 * (y1 - y0), z0 + 0.2),
        (x0 + 0.7 * (x1 - x0), y0 + 0.7 * (y1 - y0), z1 - 0.2),
        (n_env, 3),
    )
    rpy = rng.uniform((-tilt, -tilt, -np.pi), (tilt, tilt, np.pi), (n_env, 3))
    kind = rng.choice([0, SPHERE, CYLINDER, BOX], (n_env, n_obstacle), p=[0.1, 0.3, 0.3, 0.3])
    size = rng.uniform(0.15, 0.5, (n_env, n_obstacle, 3))
    size[..., 1] = np.where(kind == BOX, size[..., 1], size[..., 0])
    obstacle_pos = rng.uniform((x0, y0, z0 + 0.2), (x1, y1, z1 - 0.2), (n_env, n_obstacle, 3))
    full = (rng.random((n_env, n_obstacle)) < 1 / 3) & (kind != SPHERE)
    size[..., 2] = np.where(kind == SPHERE, size[..., 0], np.where(full, 0.5 * (z1 - z0), size[..., 2]))
    obstacle_pos[..., 2] = np.where(full, 0.5 * (z0 + z1), obstacle_pos[..., 2])
    offset = np.abs(obstacle_pos - pos[:, None])
    reach = np.hypot(size[..., 0], np.where(kind == BOX, size[..., 1], 0.0)) + 0.3
    touching = (np.hypot(offset[..., 0], offset[..., 1]) < reach) & (offset[..., 2] < size[..., 2] + 0.3)
    kind[touching] = 0
    exact = {
        "pos": pos,
        "quat": quaternions(rpy),
        "vel_b": rng.normal(0.0, 0.6, (n_env, 3)),
        "obstacle_pos": obstacle_pos,
        "obstacle_vel": rng.normal(0.0, 0.8, (n_env, n_obstacle, 3)) * (1.0, 1.0, 0.0),
        "size": size,
        "yaw": rng.uniform(-np.pi, np.pi, (n_env, n_obstacle)),
    }
    return {
        "kind": kind,
        **{name: value.astype(np.float32).astype(np.float64) for name, value in exact.items()},
    }


def quaternions(rpy):
    """Unit quaternions (w, x, y, z) of Z-Y-X angles [n, 3]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(0.5 * rpy).T, np.sin(0.5 * rpy).T
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=1,
    )


def rotation(q):
    """R_wb of one quaternion (w, x, y, z), by the Rodrigues form rather than the kernel's polynomial."""
    q = q / np.linalg.norm(q)
    cross = np.array([[0, -q[3], q[2]], [q[3], 0, -q[1]], [-q[2], q[1], 0]])
    return np.eye(3) + 2 * q[0] * cross + 2 * cross @ cross


class Caster:
    """One scene compiled to a MuJoCo model; the tank is one big geom seen from the inside."""

    def __init__(self, scene, env, tank):
        spec = mujoco.MjSpec()
        centre = [0.5 * (tank.x_m[0] + tank.x_m[1]), 0.5 * (tank.y_m[0] + tank.y_m[1]), 0.0]
        if tank.shape == "circle":
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=centre, size=[tank.radius_m, 1.0e4, 0]
            )
        else:
            half = [0.5 * (tank.x_m[1] - tank.x_m[0]), 0.5 * (tank.y_m[1] - tank.y_m[0]), 1.0e4]
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=half)
        shapes = {
            SPHERE: mujoco.mjtGeom.mjGEOM_SPHERE,
            CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER,
            BOX: mujoco.mjtGeom.mjGEOM_BOX,
        }
        for body in np.flatnonzero(scene["kind"][env]):
            kind, size, yaw = scene["kind"][env, body], scene["size"][env, body], scene["yaw"][env, body]
            spec.worldbody.add_geom(
                type=shapes[kind],
                pos=scene["obstacle_pos"][env, body],
                size=[size[0], size[2], 0] if kind == CYLINDER else size,
                quat=[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)],
            )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)

    def distances(self, start, rays):
        """Distance in units of each ray's length [n] for rays [n, 3] from one point; NOTHING_M = none."""
        length = np.linalg.norm(rays, axis=1)
        n = len(rays)
        geom, found = np.zeros(n, np.int32), np.zeros(n)
        unit = np.ascontiguousarray(rays / length[:, None]).ravel()
        mujoco.mj_multiRay(
            self.model, self.data, np.array(start), unit, None, 1, -1, geom, found, None, n, NOTHING_M
        )
        return np.where(geom < 0, NOTHING_M, found / length)


def envelope(cast, rays, jitter):
    """(lowest, highest) distance over a ray and its neighbours turned by ``jitter`` [rad] across it."""
    across = np.cross(rays, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upward = np.cross(across, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    scale = jitter * np.linalg.norm(rays, axis=1, keepdims=True)
    around = [rays + scale * (a * across + b * upward) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    found = np.stack([cast(r) for r in around])
    return found.min(axis=0), found.max(axis=0)


def load(scene, vehicle, world):
    """Copy a scene into the simulator's structs."""
    single = {name: value.astype(np.float32) for name, value in scene.items() if name != "kind"}
    vehicle.pos_w.from_numpy(single["pos"])
    vehicle.quat_wb.from_numpy(single["quat"])
    vehicle.vel_b.from_numpy(single["vel_b"])
    world.kind.from_numpy(scene["kind"].astype(np.int32))
    for field, name in (
        (world.pos_w, "obstacle_pos"),
        (world.vel_w, "obstacle_vel"),
        (world.size, "size"),
        (world.yaw, "yaw"),
    ):
        field.from_numpy(single[name])


def one_obstacle_scene(n_env, n_obstacle, pos, **body):
    """The same level vehicle at ``pos`` with heading 0 and at most one obstacle in every env."""
    scene = {
        "pos": np.tile(np.asarray(pos, float), (n_env, 1)), "quat": np.tile([1.0, 0.0, 0.0, 0.0], (n_env, 1)),
        "vel_b": np.zeros((n_env, 3)), "kind": np.zeros((n_env, n_obstacle), int),
        "obstacle_pos": np.zeros((n_env, n_obstacle, 3)), "obstacle_vel": np.zeros((n_env, n_obstacle, 3)),
        "size": np.ones((n_env, n_obstacle, 3)), "yaw": np.zeros((n_env, n_obstacle)),
    }  # fmt: skip
    for name, value in body.items():
        scene[name][:, 0] = value
    return scene
