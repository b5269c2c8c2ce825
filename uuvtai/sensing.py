"""Who fills what the stack senses: the simulator's kernels, or somebody outside (``uuvtai.pilot``)."""

from __future__ import annotations

from typing import Protocol

from uuvtai.config import SensorsConfig
from uuvtai.kernels.sensors import depth, head, proprioception, sonar, sonar_image
from uuvtai.stages import Stages


class SensorSource(Protocol):
    """Fills readings of the awake rows, in this order in every control step."""

    loses_velocity: bool
    """the DVL may be silent where no filter estimates the velocity: then ``find_velocity`` runs"""

    def sense_motion(self, stages: Stages) -> None:
        """Readings of ``ego``: DVL, IMU, pressure, a position where it is given. The pose filter, if any,
        predicts between this and the sonar."""
        ...

    def sense_sonar(self, stages: Stages) -> None:
        """``scan``; the own pose at a ping is the one that ``ego`` holds now."""
        ...

    def sense_depth(self, stages: Stages) -> None:
        """``image``; by now the pose filter has used the scan."""
        ...


class SimulatedSensors:
    """The simulator's own: from the truth, with errors as configured."""

    def __init__(self, sensors_cfg: SensorsConfig) -> None:
        sonar_cfg = sensors_cfg.sonar
        self._mechanical, self._detects = sonar_cfg.mechanical, sonar_cfg.detector != "none"
        self.loses_velocity = proprioception.loses_velocity(sensors_cfg)

    def sense_motion(self, stages: Stages) -> None:
        """All instruments but sonar and camera."""
        proprioception.sense_proprioception(stages.proprioception)

    def sense_sonar(self, stages: Stages) -> None:
        """The ring or fan of beams, or the mechanical one; its image first, where ranges come from that."""
        if self._detects:
            sonar_image.hear(stages.sonar)
        if self._mechanical:
            head.turn_head(stages.sonar)
        else:
            sonar.cast_sonar(stages.sonar)

    def sense_depth(self, stages: Stages) -> None:
        """The depth camera."""
        depth.cast_depth(stages.depth)


def forget_readings(stages: Stages) -> None:
    """No reading yet in the rows that are awake, whoever fills them."""
    proprioception.reset_proprioception(stages.proprioception)
    sonar.reset_sonar(stages.sonar)
    depth.reset_depth(stages.depth)
