"""Names of the presets that are built in: what the help, the completion and the loader all read, quickly."""

from __future__ import annotations

from pathlib import Path

PRESET_DIR = Path(__file__).parents[1] / "presets"
KINDS = {
    "world": "worlds",
    "sensors": "sensors",
    "vehicle": "vehicles",
    "stack": "stacks",
    "tree": "trees",
    "train": "train",
    "grid": "grids",
}
"""kind -> folder in ``PRESET_DIR``"""
POLICY = "policy"
"""agent whose network is built in, and the preset that trained it"""
TRAINING_TREE = "bt"
"""tree beside a policy: what it was distilled from, and what its observation's teacher columns come from"""


def preset_names(kind: str) -> list[str]:
    """Names of what is built in of a kind (``KINDS``)."""
    folder = PRESET_DIR / KINDS[kind]
    return sorted(path.stem for path in folder.iterdir() if path.suffix in (".yaml", ".xml"))


def built_in_agents() -> list[str]:
    """Who drives by what is built in: trees, stacks, the policy."""
    return [*preset_names("tree"), *preset_names("stack"), POLICY]


def built_in_file(kind: str, name: str) -> Path:
    """File of a built-in preset."""
    return PRESET_DIR / KINDS[kind] / f"{name}{'.xml' if kind == 'tree' else '.yaml'}"
