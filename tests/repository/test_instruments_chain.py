"""``uuv sitl --as a50,ping360``, an autopilot and ``uuv pilot --arm``, each a process, to the goal."""

from pathlib import Path
from queue import SimpleQueue

import pytest

from benchmarks.instruments import PORTS, Process, Setup, Waters, flown
from tests.mavlink_vehicle import free_port

PLACES = {"world.spawn_x_m": [2, 6], "world.start_goal_gap_m": 3.0}


class UsualSteps(Setup):
    """The sonar steps as in its preset, and sees as far (6 m): its kernels are compiled for other tests."""

    def rig(self, folder):
        path = super().rig(folder)
        path.write_text(path.read_text().replace("step_overhead_s: 0.03", "step_overhead_s: 0.02"))
        return path


@pytest.mark.skipif(not Path("/proc/net/udp").exists(), reason="asks Linux what a socket has read")
def test_a_pilot_arrives_by_what_emulated_instruments_tell(tmp_path):
    said, pilots = [], SimpleQueue()
    with Process(tmp_path) as process, Process(tmp_path) as pilot:
        pilots.put(pilot)
        setup = UsualSteps(static=0, range_m=6.0, changes=PLACES)
        waters = Waters(process, setup, tmp_path, 0, 1, **{name: free_port() for name in PORTS})
        assert flown(waters, pilots, said.append, 0) == "success", (said, pilot.lines)
        assert pilot.lines[-1] == "ended 0" and "goal reached" in pilot.lines[-2]
