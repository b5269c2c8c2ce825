"""What may go wrong with a vehicle: every rule ends in its action, nothing is asked beyond the limits."""

import dataclasses
import math
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uuvtai.vehicle import safety

LIMITS = safety.SafetyLimits(box_m=(0.0, 0.0, 20.0, 6.0), depth_m=(0.2, 1.4))
FINE = safety.VehicleView(
    now_s=100.0, wanted=(0.3, 0.1, 0.05, 0.2), held=(), vehicle_age_s=0.5, operator_age_s=0.5,
    sensor_age_s={"imu": 0.02, "dvl": 0.1, "pressure": 0.1, "sonar": 0.1}, pos_w=(10.0, 3.0, -0.8),
    rpy=(0.0, 0.0, 0.0), speed_m_s=0.3, battery_v=15.0, battery_share=0.8, stalled_s=0.0, lost_command="",
)  # fmt: skip
DRIVE, HOLD, SURFACE, HAND_BACK = safety.SafeAction
NAN = math.nan


def changed(**values):
    return dataclasses.replace(FINE, **values)


def after(view, seconds, memory=None):
    """The decision when a view has lasted so long, a tenth of a second at a time, and what is remembered."""
    memory, decision = memory or safety.SafetyMemory(), None
    for tick in range(round(10 * seconds) + 1):
        now = view.now_s + 0.1 * tick
        decision, memory = safety.decide(dataclasses.replace(view, now_s=now), memory, LIMITS)
    return decision, memory


def test_all_is_well():
    decision, memory = after(FINE, 120)
    assert decision.action == DRIVE and decision.reasons == ()
    assert decision.velocity == pytest.approx(FINE.wanted)
    assert memory == safety.SafetyMemory()


LOST = {"imu": 0.02, "dvl": 0.1, "pressure": 0.1, "sonar": 0.1}
WRONG = [
    # rule, view, actions by time
    ("command lost", {"lost_command": "the mode is MANUAL now"}, {0: HAND_BACK}),
    ("autopilot silent", {"vehicle_age_s": 3.1}, {0: HAND_BACK}),
    ("autopilot silent", {"vehicle_age_s": math.inf}, {0: HAND_BACK}),
    ("operator silent", {"operator_age_s": 2.1}, {0: HOLD, 29: HOLD, 30.5: SURFACE}),
    ("operator silent", {"operator_age_s": math.inf}, {0: HOLD, 30.5: SURFACE}),
    ("navigation lost", {"sensor_age_s": LOST | {"imu": 0.6}}, {0: HOLD, 4.5: HOLD, 5.5: HAND_BACK}),
    ("navigation lost", {"sensor_age_s": LOST | {"dvl": 2.1}}, {0: HOLD, 5.5: HAND_BACK}),
    ("navigation lost", {"sensor_age_s": LOST | {"pressure": 2.1}}, {0: HOLD, 5.5: HAND_BACK}),
    ("navigation lost", {"sensor_age_s": LOST | {"position": 0.6}}, {0: HOLD, 5.5: HAND_BACK}),
    ("navigation lost", {"sensor_age_s": LOST | {"imu": math.inf}}, {0: HOLD, 5.5: HAND_BACK}),
    ("sonar lost", {"sensor_age_s": LOST | {"sonar": 1.1}}, {0: HOLD, 29: HOLD, 30.5: SURFACE}),
    ("pilot stops", {"held": ("sonar: 1.5 s old",)}, {0: HOLD, 30.5: SURFACE}),
    ("pilot stops", {"wanted": (NAN, 0.0, 0.0, 0.0)}, {0: HOLD, 30.5: SURFACE}),
    ("computer late", {"stalled_s": 0.3}, {0: HOLD, 60: HOLD}),
    ("computer slow", {"late_s": 0.6}, {0: HOLD, 4.5: HOLD, 5.5: HAND_BACK}),
    ("battery silent", {"battery_age_s": 11.0}, {0: HOLD, 29: HOLD, 30.5: HAND_BACK}),
    ("position jumped", {"moved": "by 3.0 m in 0.1 s"}, {0: HAND_BACK}),
    ("start unchecked", {"unchecked": "no wall is seen"}, {0: HOLD, 59: HOLD}),
    ("walls misfit", {"misfit": "by 0.5 m"}, {0: HOLD, 4.5: HOLD, 5.5: HAND_BACK}),
    ("no answer", {"unanswered_s": 4.1}, {0: HOLD, 4.5: HOLD, 5.5: HAND_BACK}),
    ("battery low", {"battery_v": 13.1}, {0: DRIVE, 4.5: DRIVE, 5.5: SURFACE}),
    ("battery low", {"battery_share": 0.19}, {0: DRIVE, 5.5: SURFACE}),
    ("tilted", {"rpy": (math.radians(46), 0.0, 0.0)}, {0: HOLD, 2.5: HOLD, 3.5: HAND_BACK}),
    ("tilted", {"rpy": (0.0, math.radians(-46), 0.0)}, {0: HOLD, 3.5: HAND_BACK}),
    ("tilted", {"rpy": (math.pi, 0.0, 0.0)}, {0: HOLD, 3.5: HAND_BACK}),
    ("tilted", {"rpy": (NAN, 0.0, 0.0)}, {0: HOLD, 3.5: HAND_BACK}),
    ("outside the fence", {"pos_w": (20.1, 3.0, -0.8)}, {0: HOLD, 5.5: HAND_BACK}),
    ("outside the fence", {"pos_w": (10.0, -0.1, -0.8)}, {0: HOLD, 5.5: HAND_BACK}),
    ("outside the fence", {"pos_w": (10.0, 3.0, -1.5)}, {0: HOLD, 5.5: HAND_BACK}),
    ("outside the fence", {"pos_w": (10.0, 3.0, -0.1)}, {0: HOLD, 5.5: HAND_BACK}),
    ("outside the fence", {"pos_w": (NAN, 3.0, -0.8)}, {0: HOLD, 5.5: HAND_BACK}),
    ("too fast", {"speed_m_s": 1.1}, {0: DRIVE, 1.5: HOLD, 6.5: HAND_BACK}),
    ("too fast", {"speed_m_s": NAN}, {0: DRIVE, 1.5: HOLD, 6.5: HAND_BACK}),
]
UNKNOWN = {"battery_v": None, "battery_share": None, "battery_age_s": math.inf, "speed_m_s": None}
"""what other rules look after, or nobody tells"""


@pytest.mark.parametrize(
    ("name", "values", "actions"), WRONG, ids=lambda value: str(value).replace(" ", "_")[:40]
)
def test_what_goes_wrong_ends_in_its_action(name, values, actions):
    for seconds, action in actions.items():
        decision, _ = after(changed(**values), seconds)
        assert decision.action == action
        if action != DRIVE:
            assert decision.velocity == safety.STOP and decision.reasons[0].startswith(f"{name}: ")
    best = DRIVE
    grave = max(step for _, step in next(rule for rule in safety.RULES if rule.name == name).actions)
    assert max(actions.values()) == grave > best, "the gravest action of the rule is tried"


def test_every_rule_is_tried():
    assert {name for name, _, _ in WRONG} == {rule.name for rule in safety.RULES}


def test_holding_ends_with_its_reason_and_counts_anew():
    lost = changed(operator_age_s=5.0)
    _, memory = after(lost, 29)
    decision, memory = safety.decide(changed(now_s=129.2), memory, LIMITS)
    assert decision.action == DRIVE and memory.since_s == {}
    decision, _ = after(dataclasses.replace(lost, now_s=129.3), 29, memory)
    assert decision.action == HOLD


@pytest.mark.parametrize(
    ("values", "seconds", "action"),
    [({"battery_v": 12.0}, 6, SURFACE), ({"rpy": (1.0, 0.0, 0.0)}, 4, HAND_BACK)],
)
def test_surfacing_and_handing_back_are_for_good(values, seconds, action):
    first, memory = after(changed(**values), seconds)
    decision, memory = after(changed(now_s=200.0), 10, memory)
    assert decision.action == action and decision.reasons == first.reasons
    assert decision.velocity == safety.STOP


def test_the_gravest_action_counts_and_an_operator_who_takes_over_outweighs_surfacing():
    low = {"battery_v": 12.0}
    _, memory = after(changed(**low), 6)
    taken = changed(**low, now_s=106.1, lost_command="the mode is MANUAL now")
    decision, _ = safety.decide(taken, memory, LIMITS)
    assert decision.action == HAND_BACK and decision.reasons == ("command lost: the mode is MANUAL now",)
    both, _ = after(changed(operator_age_s=3.0, sensor_age_s=LOST | {"sonar": 2.0}), 0)
    assert both.action == HOLD and len(both.reasons) == 2


def test_nobody_tells_of_a_battery():
    assert after(changed(**UNKNOWN), 60)[0].action == DRIVE


# ------------------------------------------------------------------------------------------------- the limits

floats = partial(st.floats, allow_subnormal=False)
"""kernels that ran in this process before have switched subnormal numbers off"""
ANY = floats(allow_nan=True, allow_infinity=True)
SPEEDS = st.tuples(ANY, ANY, ANY, ANY)


@given(SPEEDS)
@settings(max_examples=300, deadline=None)
def test_no_speed_is_beyond_the_limits(wanted):
    surge, sway, heave, turn = safety.bounded(wanted, LIMITS)
    assert math.hypot(surge, sway) <= LIMITS.speed_m_s * (1 + 1e-9)
    assert abs(heave) <= LIMITS.heave_m_s and abs(turn) <= LIMITS.yaw_rate_rad_s
    if not all(map(math.isfinite, wanted)):
        assert (surge, sway, heave, turn) == safety.STOP


@given(SPEEDS, st.tuples(floats(-5, 25), floats(-5, 11), floats(-3, 1)), floats(-math.pi, math.pi))
@settings(max_examples=500, deadline=None)
def test_nobody_is_driven_out_of_the_fence(wanted, pos_w, yaw):
    view = changed(pos_w=pos_w, rpy=(0.0, 0.0, yaw))
    surge, sway, heave, _ = safety.allowed(wanted, view, LIMITS)
    assert math.hypot(surge, sway) <= LIMITS.speed_m_s * (1 + 1e-9) and abs(heave) <= LIMITS.heave_m_s
    velocity = (
        math.cos(yaw) * surge - math.sin(yaw) * sway,
        math.sin(yaw) * surge + math.cos(yaw) * sway,
        heave,
    )
    low, high = (0.0, 0.0, -1.4), (20.0, 6.0, -0.2)
    for axis, (rate, line_m) in enumerate(((0.5, 0.05), (0.5, 0.05), (1.5, 0.02))):
        rooms = high[axis] - pos_w[axis], pos_w[axis] - low[axis]
        above, below = (rate * max(room - line_m, 0.0) for room in rooms)
        assert -below - 1e-9 <= velocity[axis] <= above + 1e-9


def test_in_the_open_the_wish_is_kept():
    assert safety.allowed((0.3, -0.2, 0.1, 0.5), changed(rpy=(0.0, 0.0, 1.1)), LIMITS) == pytest.approx(
        (0.3, -0.2, 0.1, 0.5)
    )
    fast = safety.allowed((3.0, 4.0, 9.0, -9.0), FINE, LIMITS)
    assert fast == pytest.approx((0.3, 0.4, 0.3, -0.8)), "the direction is kept"


@pytest.mark.parametrize(
    ("pos_w", "out"),
    [
        ((10, 3, -0.8), -0.6),
        ((21, 3, -0.8), 1.0),
        ((10, 3, -2.0), 0.6),
        ((10, 3, 0.0), 0.2),
        ((NAN, 3, -1), math.inf),
    ],
)
def test_how_far_outside(pos_w, out):
    assert safety.outside_m(pos_w, LIMITS) == pytest.approx(out)
