"""What only the simulator knows, for a critic and a reward in training: the bodies' true places, now and
later, lane for lane beside the tracks, and what a decision has earned."""

import taichi as ti

from uuvtai.kernels.core.geometry import NONE
from uuvtai.kernels.core.signature import AnyTensor, Bundle, FloatMatrix, FloatVector, IntVector
from uuvtai.twin.kinematics import earned
from uuvtai.twin.sensing_model import now_and_later, write_truth
from uuvtai.twin.twin_arrays import AT_FLIP, AT_POS, TRUTH_WIDTH, TrueBodiesIO, TwinRules

SAME_M = 1.5
"""[m] a track belongs to the nearest moving body whose centre is not farther from it"""
FARTHEST_M = 1e3


@ti.func
def know_places(env, io: Bundle[TrueBodiesIO], path: AnyTensor, ego: FloatMatrix, known: AnyTensor):
    """The truth of every moving body of a row, in the order of the bodies."""
    for i in ti.static(range(3)):
        ego[env, AT_POS + i] = io.vehicle.pos_w[env][i]
    for i in ti.static(range(2)):
        ahead = io.mission.goal_w[env][i] >= io.mission.start_w[env][i]
        ego[env, AT_FLIP + i] = 1.0 if ahead else -1.0
    t_s = io.clock.step[env] * io.episode_cfg.control_dt_s
    first = io.world.kind.shape[1] - path.shape[1]
    for lane in range(path.shape[1]):
        for i in ti.static(range(TRUTH_WIDTH)):
            known[env, lane, i] = 0.0
        if io.world.kind[env, first + lane] != NONE:
            places = now_and_later(env, lane, t_s, path)
            over = (
                io.world.pos_w[env, first + lane][2]
                - io.world.size[env, first + lane][2]
                - io.vehicle.pos_w[env][2]
            )
            flip = ti.Vector([ego[env, AT_FLIP], ego[env, AT_FLIP + 1]])
            x, y = ego[env, AT_POS], ego[env, AT_POS + 1]
            write_truth(env, lane, places, over, flip, x, y, known)


@ti.func
def nearest_free(env, x, y, within_m, taken, io: Bundle[TrueBodiesIO], known: AnyTensor):
    """Number of the body that is nearest to a place, not taken (a bit for each) and not farther than
    ``within_m``; -1 = none."""
    best, found = within_m, -1
    first = io.world.kind.shape[1] - known.shape[1]
    for lane in range(known.shape[1]):
        if known[env, lane, 2] > 0.5 and (taken >> lane) & 1 == 0:
            at = io.world.pos_w[env, first + lane]
            far = ti.sqrt((at[0] - x) ** 2 + (at[1] - y) ** 2)
            if far <= best:
                best, found = far, lane
    return found


@ti.func
def put_truth(env, lane, body, known: AnyTensor, truth: AnyTensor):
    """A body's truth into a lane; body -1 = nothing."""
    for i in ti.static(range(TRUTH_WIDTH)):
        truth[env, lane, i] = known[env, body, i] if body >= 0 else 0.0


@ti.kernel
def see_truth(
    io: Bundle[TrueBodiesIO],
    path: AnyTensor,
    raw: AnyTensor,
    ego: FloatMatrix,
    known: AnyTensor,
    truth: AnyTensor,
):
    """``truth`` (n, lanes, TRUTH_WIDTH) beside the tracks ``raw`` (n, lanes, RAW_WIDTH): a lane with a track
    has the body nearest to it, the nearest track first; then lanes without one have the other bodies, the
    nearest to the vehicle first. Bodies that no lane is left for are left out.

    ``path`` (n, n_dynamic, 16) as in a bank; ``ego`` (n, EGO_WIDTH) and ``known`` (n, n_dynamic, TRUTH_WIDTH)
    are scratch.
    """
    for env in range(ego.shape[0]):
        know_places(env, io, path, ego, known)
        taken = 0
        for lane in range(raw.shape[1]):
            body = -1
            if raw[env, lane, 13] > 0.5:
                body = nearest_free(env, raw[env, lane, 0], raw[env, lane, 1], SAME_M, taken, io, known)
            put_truth(env, lane, body, known, truth)
            if body >= 0:
                taken |= 1 << body
        own = io.vehicle.pos_w[env]
        for lane in range(raw.shape[1]):
            if raw[env, lane, 13] < 0.5:
                body = nearest_free(env, own[0], own[1], FARTHEST_M, taken, io, known)
                put_truth(env, lane, body, known, truth)
                if body >= 0:
                    taken |= 1 << body


@ti.kernel
def reward_decisions(
    io: Bundle[TwinRules], nearer: FloatVector, nearest: FloatVector, ended: IntVector, reward: FloatVector
):
    """The twin's reward (n,) of decisions that brought vehicles ``nearer`` [m] to their goals and within
    ``nearest`` [m] of anything; ``ended``: outcome codes."""
    for env in range(reward.shape[0]):
        reward[env] = earned(nearer[env], nearest[env], ended[env], io)
