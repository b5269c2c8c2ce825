"""What every stage of a step does, in the words of its kernel files and in the order of the step."""

from __future__ import annotations

import ast
from pathlib import Path

import uuvtai

KERNELS = Path(uuvtai.__file__).parent / "kernels"

FILES = {
    "dynamics": ("thruster_fault", "control", "dynamics"),
    "world": ("scenario", "motion", "episode"),
    "proprioception": ("proprioception",),
    "sonar": ("sonar", "sonar_image", "raycast"),
    "localization": ("localization",),
    "depth": ("depth_camera",),
    "tracking": ("tracking", "track_filter", "height", "prediction", "camera_tracking"),
    "mapping": ("sensor_model", "mapping"),
    "clearance": ("clearance",),
    "planning": ("triggers", "voronoi", "medial_axis", "route"),
    "observation": ("observation",),
    "behavior": ("threats", "avoidance", "dwa", "mppi", "tree"),
    "reward": ("reward",),
}
"""kernel files of each stage, by the names of ``uuvtai.sim.stages.STAGES``"""


def page() -> str:
    """All stages."""
    parts = [
        "# Stages of a step",
        "One control step runs these stages in this order; a row of `uuv profile` carries the same name. The "
        "text is that of the files in `uuvtai/kernels/`. What they stand on, and what is assumed: "
        "[simulator](../simulator.md), [navigation](../navigation.md).",
    ]
    for stage, files in FILES.items():
        parts.append(f"## {stage}")
        parts += [f"### `{name}.py`\n\n{_docstring(name)}" for name in files]
    return "\n\n".join(parts) + "\n"


def _docstring(name: str) -> str:
    (path,) = KERNELS.glob(f"*/{name}.py")
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    if not text:
        raise ValueError(f"{path} has no docstring for the page of stages; write one")
    return text
