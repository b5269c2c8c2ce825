"""What drives an evaluation: behaviour trees and stacks by name, trained policies by run folder, checkpoint
folder, and plugins that the user brings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uuvtai.common.errors import SettingError
from uuvtai.common.presets import POLICY, TRAINING_TREE, built_in_agents, preset_names
from uuvtai.config import Config
from uuvtai.config.loader import STACK_SECTIONS, ConfigError, nearest, preset_path, tree_of_stack, with_stack
from uuvtai.learning.agents import find_policy
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.export.folder import export
from uuvtai.plugins.api import is_plugin, plugin_spec
from uuvtai.sim.behavior_tree import FlatTree, read_tree

if TYPE_CHECKING:
    from uuvtai.logs.writer import PolicyNote
    from uuvtai.plugins.loading import LoadedPlugin
    from uuvtai.sim.rrt import RoutePlanner
    from uuvtai.sim.sim import Sim


TRUTH = "truth"  # suffix of a tree's name: an oracle whose tracks of moving obstacles are the truth

_STACK = (
    "tracking", "forecast", "height", "mapping", "clearance", "voronoi", "quiet", "route", "behavior",
    "fast", "actuation", "episode",
)  # fmt: skip
"""sections that shape what a policy sees and does; differences from its training are told, not refused"""


@dataclass(frozen=True)
class AgentSpec:
    """One row of the table of agents."""

    name: str
    tree: FlatTree
    checkpoint: Checkpoint | None = None
    """None = the tree drives"""
    privileged: bool = False
    """its tracks of moving obstacles are the truth"""
    stack: str | None = None
    """stack preset (name or path) that this row alone drives with; None = the request's own"""
    own: LoadedPlugin | None = None
    """what the user brought: it drives, or plans the routes of the tree"""

    def config_of(self, config: Config) -> Config:
        """What this agent's simulator runs on; scenarios, sensors and termination check are those of
        ``config``. Raises ConfigError."""
        return config if self.stack is None else with_stack(config, self.stack)

    def agent_for(self, sim: Sim) -> PolicyNote | None:
        """The policy ready for this simulator's rows; None where the tree drives. Raises CheckpointError or
        PluginError for one that does not fit."""
        if self.own is not None:
            from uuvtai.logs.writer import PolicyNote

            agent = self.own.agent(sim)
            return None if agent is None else PolicyNote(agent, self.own.sha256, None)
        if self.checkpoint is None:
            return None
        from uuvtai.learning.agents import load_trained
        from uuvtai.logs.writer import PolicyNote

        agent = load_trained(self.checkpoint, sim)
        weight = self.checkpoint.manifest.metrics.get("distillation/lambda")
        return PolicyNote(agent, self.checkpoint.sha256, weight if isinstance(weight, float) else None)

    def planner_for(self, sim: Sim) -> RoutePlanner | None:
        """Who plans this simulator's routes in place of its own planners; None = they do. PluginError."""
        return None if self.own is None else self.own.planner(sim)

    def document(self) -> dict[str, Any]:
        """What ``uuv eval --json`` says of a policy, a stack or a plugin of the user's beside its results."""
        if self.own is not None:
            return {"own": self.own.document()}
        if self.checkpoint is None:
            if self.stack is None:
                return {}
            return {"stack": {"preset": self.stack, "tree": tree_of_stack(self.stack)}}
        found = self.checkpoint
        return {
            "checkpoint": {
                "path": "built-in" if self.name == POLICY else str(found.path),
                "sha256": found.sha256,
                "step": found.step,
                "version": found.manifest.version,
            }
        }


def load_agents(names: Sequence[str], note: Callable[[str], None] = lambda _text: None) -> list[AgentSpec]:
    """Every kind of agent by the name that ``--agent`` takes: trees and stacks, each perhaps with ``+truth``,
    the user's own plugins, trained policies. ``note`` is told of checkpoints that were left out. Raises
    ConfigError, CheckpointError, PluginError."""
    found: dict[str, AgentSpec] = {}
    for name in dict.fromkeys(names):
        agent = _load(name, note)
        if agent.name in found:
            raise ConfigError(
                f"--agent {name}: two rows would be called {agent.name}; rename a file, a function or a run "
                "folder, or evaluate them one by one"
            )
        found[agent.name] = agent
    return list(found.values())


def _load(name: str, note: Callable[[str], None]) -> AgentSpec:
    if is_plugin(name):
        return _plugin_agent(name)
    if is_trained(name):
        checkpoint = find_policy(name, note)
        return AgentSpec(policy_name(name, checkpoint), read_tree(TRAINING_TREE), checkpoint)
    base, privileged = _parted(name)
    label = f"{_label(base)}+{TRUTH}" if privileged else _label(base)
    stack = base if _is_stack(base) else None
    tree = tree_of_stack(base) if stack else base
    return AgentSpec(label, read_tree(tree), privileged=privileged, stack=stack)


def _plugin_agent(name: str) -> AgentSpec:
    """A plugin of the user's: what it leaves to the stack, the training tree's does."""
    from uuvtai.plugins.loading import load_plugin

    try:
        found = load_plugin(plugin_spec(name))
    except SettingError as error:
        raise ConfigError(str(error)) from None
    return AgentSpec(found.label, read_tree(TRAINING_TREE), own=found)


def is_trained(name: str) -> bool:
    """Whether a network drives: the built-in one, or one of a run folder or a checkpoint folder; names of
    what is built in come first."""
    return name == POLICY or (name not in built_in_agents() and Path(name).is_dir())


def _is_stack(name: str) -> bool:
    """Whether an agent's name is that of a stack preset, or a path of one; ConfigError for what is neither
    tree nor stack."""
    if name.endswith((".yaml", ".yml")):
        preset_path("stack", name)
        return True
    trees, stacks = preset_names("tree"), preset_names("stack")
    if name in stacks and name not in trees:
        return True
    if name not in trees and not name.endswith(".xml"):
        raise ConfigError(
            f"--agent {name}: is no preset, file or run folder{nearest(name, built_in_agents())}; presets: "
            f"{', '.join(built_in_agents())}; or give a tree's .xml, a stack's .yaml, mine.py:act, "
            "mine.py:load, model.onnx, or the run folder of 'uuv train'"
        )
    return False


def observation_of(names: Sequence[str]) -> list[tuple[str, Any]]:
    """Overrides that give the observation the columns that the trained policies among these agents know.
    ConfigError where they differ among themselves."""
    trained = [name for name in names if not is_plugin(name) and is_trained(name)]
    sections = {name: find_policy(name).config.observation.model_dump(mode="json") for name in trained}
    for name, section in sections.items():
        if section != next(iter(sections.values())):
            raise ConfigError(
                f"{trained[0]} and {name} see other columns ({sections[trained[0]]} and {section}); "
                "evaluate them one by one: with the same seeds they meet the same episodes"
            )
    return [("observation", section) for section in list(sections.values())[:1]]


def differences(agent: AgentSpec, config: Config) -> str:
    """What of the stack is not as in the policy's training, in words, and the preset that makes it so, if one
    does; or what an agent's own stack sets in place of what was asked for; empty = nothing."""
    if agent.stack is not None:
        return _lost(agent, config)
    if agent.checkpoint is None or not (parts := _unlike(config, trained := agent.checkpoint.config)):
        return ""
    names = preset_names("stack")
    stack = next((name for name in names if not _unlike(with_stack(config, name), trained)), None)
    mend = f"; as it was trained: --set stack={stack}" if stack else ""
    told = ", ".join(parts[:2]) + (f" and {len(parts) - 2} more" if len(parts) > 2 else "")
    return f"{agent.name} drives another stack than in its training: {told}{mend}"


def _lost(agent: AgentSpec, config: Config) -> str:
    asked, own, usual = (
        any_cfg.model_dump(mode="json") for any_cfg in (config, agent.config_of(config), Config())
    )
    lost = [
        f"{section}.{key} = {own[section][key]}, not {value}"
        for section in STACK_SECTIONS
        for key, value in asked[section].items()
        if value not in (own[section][key], usual[section][key])
    ]
    said = f"{agent.name}: its stack has {', '.join(lost)}; write a stack that 'extends: {agent.stack}'"
    return said if lost else ""


def _unlike(config: Config, trained: Config) -> list[str]:
    """Keys of the stack that differ."""
    ours, theirs = config.model_dump(mode="json"), trained.model_dump(mode="json")
    return [
        f"{section}.{key} = {value} (trained with {theirs[section].get(key)})"
        for section in _STACK
        for key, value in ours[section].items()
        if value != theirs[section].get(key)
    ]


def policy_name(name: str, checkpoint: Checkpoint) -> str:
    """What a policy is called in tables: its run, or its run and step."""
    path = Path(name).resolve()
    return path.name if path != checkpoint.path.resolve() else f"{path.parent.parent.name}-{path.name}"


def _parted(name: str) -> tuple[str, bool]:
    """(tree, whether it is told the truth) of an agent's name. Raises ConfigError."""
    if "+" not in name or name.endswith((".xml", ".yaml", ".yml")):
        return name, False
    tree, _, suffix = name.rpartition("+")
    if suffix != TRUTH:
        raise ConfigError(
            f"--agent {name}: '+{suffix}' is unknown; the one suffix is +{TRUTH}, for example {tree}+{TRUTH}"
        )
    return tree, True


def _label(name: str) -> str:
    return Path(name).stem if name.endswith((".xml", ".yaml", ".yml")) else name


# ---- A run or a checkpoint, found and exported; the stack of a log.


def export_run(
    run: str, out: Path | None, evaluations: list[Path], note: Callable[[str], None], force: bool
) -> dict[str, Any]:
    """Export to ``out`` or runs/NAME_export. Raises as ``find_policy`` and ``export``."""
    checkpoint = find_policy(run, note)
    name = policy_name(run, checkpoint)
    return export(checkpoint, name, out or Path("runs") / f"{name}_export", evaluations, note, force)


def export_log(log: Path, out: Path | None, machines: Sequence[str]) -> dict[str, Any]:
    """Export the stack of a log of ``uuv eval --record`` to ``out`` or runs/NAME_export, with its messages as
    a check. Raises as ``read_feed`` and ``vehicle.embedded.export.export_stack``."""
    from uuvtai.vehicle.embedded.export import export_stack
    from uuvtai.vehicle.replay import read_feed

    feed = read_feed(log)
    dt_s = feed.config.episode.control_dt_s
    arrivals = [(max(0, math.ceil(each.time_s / dt_s - 0.5)), each.message) for each in feed.arrivals]
    target = out or Path("runs") / f"{log.stem}_export"
    return export_stack(feed.config, feed.tree, feed.mission, arrivals, target, machines)
