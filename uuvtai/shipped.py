"""Names of the presets that are shipped: what the help, the completion and the loader all read, quickly."""

from __future__ import annotations

from pathlib import Path

PRESET_DIR = Path(__file__).parent / "presets"
KINDS = {
    "world": "worlds",
    "sensors": "sensors",
    "vehicle": "vehicles",
    "stack": "stacks",
    "tree": "trees",
    "train": "train",
    "grid": "grids",
    "policy": "policies",
}
"""kind -> folder in ``PRESET_DIR``"""
TRAINING_TREE = "bt"
"""tree beside a policy: what it was distilled from, and what its observation's teacher columns come from"""


def preset_names(kind: str) -> list[str]:
    """Names of what is shipped of a kind (``KINDS``)."""
    folder = PRESET_DIR / KINDS[kind]
    if kind == "policy":
        return sorted(path.parent.name for path in folder.glob("*/manifest.json"))
    return sorted(path.stem for path in folder.iterdir() if path.suffix in (".yaml", ".xml"))


def shipped_file(kind: str, name: str) -> Path:
    """File of a shipped preset; of a policy, its model card."""
    folder = PRESET_DIR / KINDS[kind]
    if kind == "policy":
        return folder / name / "MODEL_CARD.md"
    return folder / f"{name}{'.xml' if kind == 'tree' else '.yaml'}"
