"""Your own world: the behaviour tree crosses ``harbour.yaml``, and a picture shows what the vehicle has
mapped on the way.

``python examples/custom_world.py [PICTURE.png]`` (pip install 'uuvtai[gym]')
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt

from uuvtai import Sim, UuvEnv

WORLD = Path(__file__).with_name("harbour.yaml")


def main(picture: Path, sim: Sim | None = None, most_steps: int = 3000) -> str:
    """Runs episode 0 of seed 7 and writes the picture; tells how it ended."""
    env = UuvEnv(world=str(WORLD), render_mode="rgb_array", sim=sim)
    _obs, info = env.reset(seed=7)
    for _ in range(most_steps):
        _obs, _reward, terminated, truncated, info = env.step(info["teacher_action"])
        if terminated or truncated:
            break
    picture.parent.mkdir(parents=True, exist_ok=True)
    plt.imsave(picture, env.render())
    env.close()
    seconds = info["episode_steps"] * env.native.config.episode.control_dt_s
    return (
        f"{WORLD.name}: {info['outcome']} after {seconds:.1f} s, return {info['episode_return']:.1f}; "
        f"{picture}"
    )


if __name__ == "__main__":
    print(main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples/harbour.png")))
