"""Your own vehicle: how ``heavy_pack.yaml`` answers to a speed command, beside the BlueROV2: a table.

``python examples/custom_vehicle.py``
"""

from __future__ import annotations

from pathlib import Path

import uuvtai

VEHICLES = ("bluerov2", str(Path(__file__).with_name("heavy_pack.yaml")))
TIMES_S = (0.2, 0.5, 1.0, 2.0, 4.0)


def surge_m_s(vehicle: str) -> list[float]:
    """Forward speed at ``TIMES_S`` after the command of 0.6 m/s, through the inner loop and the thrusters."""
    trial = uuvtai.Trial(seconds=TIMES_S[-1], command=(0.6, 0, 0, 0), neutral=True)
    found = uuvtai.simulate(uuvtai.load_config("open", vehicle=vehicle), trial)
    return [found["nu"][round(time_s / found["t"][1])][0] for time_s in TIMES_S]


def main() -> str:
    """The table: surge [m/s] over time of both."""
    lines = [f"{'surge [m/s] after':20}" + "".join(f"{time_s:7.1f} s" for time_s in TIMES_S)]
    for vehicle in VEHICLES:
        lines.append(f"{Path(vehicle).stem:20}" + "".join(f"{speed:9.3f}" for speed in surge_m_s(vehicle)))
    return "\n".join(lines)


if __name__ == "__main__":
    print(main())
