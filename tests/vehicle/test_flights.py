"""Flights with faults: no order beyond limits, none while held or by old data, the operator obeyed."""

import dataclasses
import random
from types import SimpleNamespace

import pytest

from tests.flights import DT, moves, orders, violations
from tests.mavlink_vehicle import LIMITS, Flight, link_config, plan_of
from uuvtai.logs.reader import read_messages
from uuvtai.vehicle import control_loop
from uuvtai.vehicle.control_loop import OnboardLoop, as_driven
from uuvtai.vehicle.instruments.rig import Rig

FOUND = (1125,)
"""seeds that once found something"""


@pytest.mark.parametrize("seeds", [range(5), FOUND], ids=str)
def test_whatever_breaks_the_vehicle_is_safe(seeds):
    assert [text for seed in seeds for text in violations(seed)] == []


class Fix(SimpleNamespace):
    """A start that no scan tells."""

    def feed(self, message):
        pass

    def way_round(self):
        return -1.0


@pytest.mark.parametrize("sees_around", [True, False])
def test_until_the_start_is_known_it_only_turns(tmp_path, sees_around):
    flight = Flight(tmp_path)
    flight.loop._fix = Fix(result=None, waits_for="no wall is seen", first_s=0.0)
    flight.loop._sees_around = sees_around
    flight.run(4)
    assert flight.sub.moved_by() == [] and flight.loop.last.action.name == "HOLD"
    flight.run(6)
    if sees_around:
        assert flight.sub.moved_by() == [] and flight.loop.last.action.name == "HOLD"
        return flight.close()
    told = [m for m in flight.sub.told if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]
    assert told and {(m.vx, m.vy, m.vz) for m in told} == {(0.0, 0.0, 0.0)}
    assert told[-1].yaw_rate == pytest.approx(0.5), "clockwise is positive for ArduSub"
    flight.close()


@pytest.mark.parametrize(("depth_m", "gap_m"), [((0.2, 1.4), 0.22), ((0.05, 1.55), 0.2), ((0.4, 1.3), 0.32)])
def test_the_stack_plans_within_the_fence(tmp_path, depth_m, gap_m):
    plan = dataclasses.replace(
        plan_of(None, tmp_path / "a.mcap"), limits=dataclasses.replace(LIMITS, depth_m=depth_m)
    )
    assert as_driven(link_config(), plan).behavior.edge_gap_m == pytest.approx(gap_m)


@pytest.mark.parametrize(
    ("sonar", "has"), [({}, False), ({"sonar": "ping360:h"}, False), ({"sonar": "3d15:h"}, True)]
)
def test_the_stack_believes_in_nothing_that_does_not_come(tmp_path, sonar, has):
    found = as_driven(
        link_config(), dataclasses.replace(plan_of(None, tmp_path / "a.mcap"), instruments=sonar)
    )
    assert found.sensors.sonar.period_steps == 5, "no scans every 20 ms"
    assert found.camera_tracking.use_camera == found.height.use_camera == (found.mapping.depth_hit > 0) == has


class Clock:
    """Time passes only while somebody sleeps; the vehicle lives meanwhile."""

    def __init__(self, flight, dt=DT):
        self.flight, self.now_s, self.dt = flight, 1000.0, dt

    def now(self):
        return self.now_s

    def sleep(self, seconds):
        self.flight.sub.listen()
        self.flight.sub.speak(self.dt)
        self.now_s += seconds


STAGES = [
    "_pilot.tick", "_pilot.feed", "_intake.take", "_codec.decode", "_codec.encode", "_endpoint.receive",
    "_endpoint.send", "_log.begin_step", "_log.saw", "_log.said", "_log.decided", "_handover.watch",
    "_rig.poll",
    "_handover.orders", "_view", "_say", "_note", "_sleep", "_now",
]  # fmt: skip
NO_MORE = ("_codec.encode", "_endpoint.send", "_say")
"""where one of these fails for ever nothing can be said at all"""


@pytest.mark.parametrize("lasts", [False, True])
@pytest.mark.parametrize("stage", STAGES)
def test_an_error_of_ours_stops_the_vehicle_and_gives_it_back(tmp_path, monkeypatch, stage, lasts):
    if lasts and stage in NO_MORE:
        pytest.skip("nothing can be said")
    flight = Flight(tmp_path)
    clock, at = Clock(flight), random.Random(stage).uniform(1.2, 1.8)
    plan = plan_of(flight.endpoint.place, flight.log.path)
    loop = OnboardLoop(
        link_config(), flight.pilot, plan, flight.endpoint, flight.log, clock.now, clock.sleep,
        rig=Rig(link_config(), {}),
    )  # fmt: skip
    owner, _, name = stage.rpartition(".")
    broken = getattr(loop, owner) if owner else loop
    works, raised = getattr(broken, name), []

    def fails(*given, **more):
        if clock.now_s - 1000.0 >= at and (lasts or not raised):
            flight.sub.listen()
            raised.append(len(flight.sub.told))
            raise RuntimeError(f"{stage} has a bug")
        return works(*given, **more)

    monkeypatch.setattr(broken, name, fails)
    monkeypatch.setattr(control_loop, "_GIVE_BACK_S", 0.3 if lasts else 3.0)
    loop.run()
    flight.sub.listen()
    after = [message for message in flight.sub.told[raised[0] :] if orders(message)]
    assert raised and isinstance(loop.failure, RuntimeError) and not loop.document()["safe"]
    assert [message.get_type() for message in after[:2]] == ["SET_POSITION_TARGET_LOCAL_NED", "COMMAND_LONG"]
    assert not any(moves(message) for message in after) and flight.sub.mode == 2
    assert lasts or len(after) <= 2, "then it is silent"
    flight.close()
    assert list(read_messages(flight.log.path, ("/mavlink/said",)))
