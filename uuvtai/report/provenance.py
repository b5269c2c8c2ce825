"""Where figures come from: the command, the machine, the versions, the config."""

from __future__ import annotations

import hashlib
import shlex
from pathlib import Path
from typing import Any

from uuvtai.files import read_bytes
from uuvtai.report.blocks import Block, Code, Facts, Notice, Paragraph
from uuvtai.report.run_files import read_config, read_json
from uuvtai.tables.table import Table, heads
from uuvtai.tables.wording import number

MANIFEST_BYTES = 16 << 20
"""[bytes] more than any manifest of a checkpoint has"""


def command_of(record: dict[str, Any]) -> str:
    """The command line of run.json as a person types it."""
    argv = [str(word) for word in record.get("argv", [])]
    return shlex.join(["uuv", *argv[1:]]) if argv else ""


def status_notice(record: dict[str, Any]) -> list[Block]:
    """A warning where the run did not end well."""
    status = record.get("status", "unknown")
    if status == "finished":
        return []
    return [
        Notice(f"The run is marked '{status}': what follows is what was there when this page was written.")
    ]


def provenance(record: dict[str, Any]) -> list[Block]:
    """Facts of run.json."""
    hardware, versions = record.get("hardware", {}), record.get("versions", {})
    facts = {
        "command": command_of(record),
        "started": record.get("started"),
        "status": record.get("status"),
        "wall time": f"{number(record['wall_s'])} s" if "wall_s" in record else None,
        "seeds": ", ".join(map(str, record.get("seeds", []))),
        "commit": record.get("git_sha"),
        "processor": hardware.get("cpu"),
        "cores": hardware.get("cores"),
        "system": hardware.get("system"),
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
        "resumed": "; ".join(str(resumed.get("started")) for resumed in record.get("resumed", [])),
    }
    return [Facts([(name, str(value)) for name, value in facts.items() if value not in (None, "")])]


def config_text(folder: Path) -> list[Block]:
    """config.yaml, folded away."""
    text = read_config(folder)
    return [] if text is None else [Code("config.yaml", text)]


def checkpoints(folder: Path) -> list[Block]:
    """Table of the checkpoints that are kept."""
    rows = []
    for path in sorted((folder / "checkpoints").glob("*/manifest.json")):
        manifest = read_json(folder, str(path.relative_to(folder))) or {}
        files = manifest.get("files", {})
        digest = (files.get("model.safetensors") or {}).get("sha256", "-")
        rows.append(
            [
                path.parent.name,
                str(manifest.get("step", "-")),
                number(manifest.get("score"), 3),
                str(digest)[:16],
            ]
        )
    if not rows:
        return []
    columns = heads("checkpoint", "iteration", "score", "sha256 of the model (first 16 digits)")
    return [Table(columns, rows, "Checkpoints")]


def origins(methods: list[dict[str, Any]], trainings: list[Path]) -> list[Block]:
    """For every policy of an evaluation the training that made it, by the sha256 of its checkpoint's
    manifest; [] without trainings."""
    kept = {
        _sha256(path, run): (run.name, path.parent.name)
        for run in trainings
        for path in (run / "checkpoints").glob("*/manifest.json")
    }
    sentences = []
    for method in methods if trainings else []:
        digest = str(method.get("checkpoint", {}).get("sha256", ""))
        if digest in kept:
            sentences.append(
                "{} is checkpoint {} of the training {}.".format(method["name"], *reversed(kept[digest]))
            )
        elif digest:
            sentences.append(
                f"{method['name']} (checkpoint {digest[:16]}) is none of the checkpoints that these "
                "trainings keep."
            )
    return [Paragraph(" ".join(sentences))] if sentences else []


def _sha256(path: Path, run: Path) -> str:
    return hashlib.sha256(read_bytes(path, MANIFEST_BYTES, run)).hexdigest()
