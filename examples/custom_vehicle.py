"""Your own vehicle: how ``heavy_pack.yaml`` answers to full surge, beside the BlueROV2 that it extends: a
table.

``python examples/custom_vehicle.py``
"""

from __future__ import annotations

from pathlib import Path

import torch

import uuvtai

VEHICLES = ("bluerov2", str(Path(__file__).with_name("heavy_pack.yaml")))
TIMES_S = (0.2, 0.5, 1.0, 2.0, 4.0)


def surge_m_s(vehicle: str) -> list[float]:
    """Forward speed at ``TIMES_S`` after the command of full surge, through inner loop and thrusters."""
    with uuvtai.make("open", num_envs=1, vehicle=vehicle, sensors="clean") as env:
        env.reset(seed=1)
        ahead, speeds = env.columns["velocity"].start, []
        for _ in range(round(TIMES_S[-1] / env.config.episode.control_dt_s)):
            obs, *_rest = env.step(torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
            speeds.append(float(obs[0, ahead]))
        return [speeds[round(time_s / env.config.episode.control_dt_s) - 1] for time_s in TIMES_S]


def main() -> str:
    """The table: surge [m/s] over time of both."""
    lines = [f"{'surge [m/s] after':20}" + "".join(f"{time_s:7.1f} s" for time_s in TIMES_S)]
    for vehicle in VEHICLES:
        lines.append(f"{Path(vehicle).stem:20}" + "".join(f"{speed:9.3f}" for speed in surge_m_s(vehicle)))
    return "\n".join(lines)


if __name__ == "__main__":
    print(main())
