"""``uuv tree``: a behaviour tree as text, DOT or JSON, with how it was used in an evaluation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uuvtai.files import FileError, read_json
from uuvtai.loader import ConfigError, preset_names
from uuvtai.tree import FlatTree, NodeUse, read_tree, read_tree_file, tree_dot, tree_text


@dataclass(frozen=True)
class TreeReport:
    """The same tree three ways."""

    text: str
    """one line per node"""
    dot: str
    document: dict[str, Any]
    """nodes in the order of the lines, with their use where a run was given"""


def tree_report(controller: str, run: Path | None) -> TreeReport:
    """Report of a controller's tree; with a run folder, the use of its nodes there. Raises ConfigError."""
    use = None
    if run is not None:
        used = _record(run)
        if controller not in used:
            raise ConfigError(
                f"{run}: has no controller {controller!r}; there are: {', '.join(used)} (--controller NAME)"
            )
        tree = read_tree_file(run / "eval" / "trees" / f"{controller}.xml", folder=run)
        use = used[controller]
        if len(use) != len(tree.names):
            raise ConfigError(
                f"{run}: the tree {controller!r} has changed since that evaluation; run it again with 'uuv "
                "eval'"
            )
    else:
        tree = read_tree(controller)
    return TreeReport(tree_text(tree), tree_dot(tree, use), _document(controller, tree, use))


def _record(run: Path) -> dict[str, list[NodeUse]]:
    """Use of every node by controller."""
    path = run / "eval" / "tree.json"
    if not run.is_dir():
        shipped = (
            f"; the tree alone: 'uuv tree --controller {run}'" if str(run) in preset_names("tree") else ""
        )
        raise ConfigError(
            f"{run}: is no run folder; give one of an evaluation ('uuv eval' prints it){shipped}"
        )
    try:
        record = read_json(path, folder=run)
        return {name: [_use(node) for node in nodes] for name, nodes in record["use"].items()}
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror}); give the run folder of an evaluation ('uuv eval' "
            "prints it)"
        ) from None
    except FileError as error:
        raise ConfigError(f"{error}; run the evaluation again with 'uuv eval'") from None
    except (ValueError, OverflowError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ConfigError(
            f"{path}: is not what 'uuv eval' writes ({error!r}); run the evaluation again with 'uuv eval'"
        ) from None


def _use(node: dict[str, Any]) -> NodeUse:
    share, ticks, acted = node["share"], int(node["ticks"]), int(node["acted"])
    if not (isinstance(share, int | float) and 0.0 <= share <= 1.0 and 0 <= acted <= ticks):
        raise ValueError(
            f"a node ticked in {share!r:.40} of the episodes, {ticks} times, {acted} of which acted"
        )
    return NodeUse(float(share), ticks, acted)


def _document(controller: str, tree: FlatTree, use: list[NodeUse] | None) -> dict[str, Any]:
    nodes = []
    for i, name in enumerate(tree.names):
        node: dict[str, Any] = {"id": i, "name": name, "type": tree.types[i], "parent": tree.parent[i]}
        if use is not None:
            node |= vars(use[i])
        nodes.append(node)
    return {"schema": 1, "controller": controller, "source": tree.source, "nodes": nodes}
