"""What was typed on the command line as values, or UsageError; which options a resumed run refuses."""

from __future__ import annotations

import difflib
import functools
import math
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import typer

from uuvtai.common.exits import UsageError
from uuvtai.common.presets import KINDS, built_in_agents, preset_names


def integers(option: str, text: str) -> list[int]:
    """Whole numbers of 32 bits, as ``--seeds 0,1,2`` has them."""
    return [_integer(option, item) for item in text.split(",")]


def seeds(option: str, text: str) -> list[int]:
    """Seeds, as ``--seeds 0,1,2`` has them, each as kernels count with it."""
    from uuvtai.config.base import folded_seed

    given = [_integer(option, item, None) for item in text.split(",")]
    if low := [seed for seed in given if seed < 0]:
        raise UsageError(f"{option} {low[0]}: must be 0 or more")
    return [folded_seed(seed) for seed in given]


def _integer(option: str, text: str, bits: int | None = 32) -> int:
    """A whole number, of so many bits."""
    try:
        value = int(text)
    except ValueError:
        raise UsageError(
            f"{option} {text!r}: whole numbers separated by commas, for example {option} 0,1,2"
        ) from None
    if bits and not -(2 ** (bits - 1)) <= value < 2 ** (bits - 1):
        raise UsageError(f"{option} {text}: must fit {bits} bits")
    return value


def numbers(option: str, text: str | None, count: int) -> list[float] | None:
    """``count`` finite numbers, or None where none were typed."""
    if text is None:
        return None
    try:
        values = [float(item) for item in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise UsageError(
            f"{option} {text!r}: give {count} finite numbers separated by commas, without spaces"
        )
    return values


def refuse_less(option: str, value: int, least: int, most: int = 1_000_000) -> None:
    """UsageError for a count below ``least``, or of more than memory holds."""
    if not least <= value <= most:
        told = f"at least {least}" if value < least else f"at most {most:,}"
        raise UsageError(f"{option} {value}: must be {told}")


def refuse_no_duration(option: str, seconds: float) -> None:
    """UsageError for a duration that is none."""
    if not math.isfinite(seconds) or seconds <= 0:
        raise UsageError(f"{option} {seconds}: must be a positive number, for example {option} 10")


def agents(given: list[str] | None, planner: list[str] | None, default: Sequence[str]) -> list[str]:
    """Names of --agent, each alone or several with commas between; of --planner a row each. ``default``:
    where neither is typed."""
    from uuvtai.plugins.api import PLANNER, is_plugin, plugin_spec

    whole = (part for item in given or (default if not planner else []) for part in _parted(item))
    names = [plugin_spec(name).text if is_plugin(name) else name for name in whole]
    names += [plugin_spec(name, PLANNER).text for name in planner or []]
    if not names:
        raise UsageError("--agent: name who drives, for example --agent bt")
    return list(dict.fromkeys(names))


def _parted(item: str) -> list[str]:
    """Names with commas between; a text after = and a path that is there may hold commas of their own."""
    is_one = "=" in item or Path(item).exists()
    return [item] if is_one else [name for name in item.split(",") if name]


def named_plugins(given: list[str] | None, planner: list[str] | None) -> list[str]:
    """The user's own plugins where nothing else may be named."""
    from uuvtai.plugins.api import is_plugin

    if not (given or planner):
        return []
    found = agents(given, planner, [])
    if strange := [name for name in found if not is_plugin(name)]:
        raise UsageError(f"{strange[0]}: is no plugin of yours, for example --agent mine.py:act")
    return found


def one_agent(given: str | None, planner: list[str] | None) -> str | None:
    """Who drives one vehicle; None = nobody."""
    if given is None and not planner:
        return None
    found = agents([given] if given else None, planner, [])
    if len(found) != 1:
        raise UsageError("--agent, --planner: give one of them, once: one vehicle is driven")
    return found[0]


def reward(given: str | None) -> Any:
    """Reward terms of the user's (``runner.RewardSource``); None where none were typed."""
    if given is None:
        return None
    from uuvtai.plugins.api import REWARD, plugin_spec
    from uuvtai.plugins.loading import load_plugin

    return load_plugin(plugin_spec(given, REWARD))


@functools.cache
def motion(given: str | None) -> list[tuple[str, Any]]:
    """Settings for the obstacles that a function of the user's gives; none where none was typed."""
    if given is None:
        return []
    from uuvtai.plugins.api import MOTION, plugin_spec
    from uuvtai.plugins.loading import obstacles_of

    return [("world.added", obstacles_of(plugin_spec(given, MOTION)))]


def refuse_odd_rate(rate: float) -> None:
    """UsageError for a pace that is none; 0 means as fast as it goes."""
    if not (math.isfinite(rate) and rate >= 0):
        raise UsageError(f"--rate {rate:g}: give a number at least 0, for example --rate 2")


def refuse_odd_live(rate: float, port: int, tanks: int = 1, agents: int = 1, foxglove: bool = False) -> None:
    """UsageError for numbers of ``uuv watch`` and ``uuv drive`` that make no sense."""
    refuse_odd_rate(rate)
    most = 1 if foxglove else 16 // agents or 1
    if not 1 <= tanks <= most:
        why = "1 with --foxglove, for it shows one vehicle" if foxglove else f"1 to {most}"
        raise UsageError(f"--tanks {tanks}: {why}" + (f" with {agents} agents" if agents > 1 else ""))
    if not foxglove and agents > 16:
        raise UsageError(f"--agent: {agents} of them; a page shows 16 side by side")
    if not 0 <= port < 65536:
        raise UsageError(f"--port {port}: ports go from 0 (a free one) to 65535, for example --port 8765")


OF_A_SWEEP_RESUMED = (
    "allow_code", "world", "episodes", "seeds", "engine", "workers", "address", "device",
)  # fmt: skip
"""what is not refused beside ``--resume`` of a sweep"""

_TODAY = {
    "--controller": "--agent NAME",
    "--num-envs": "--set train.num_envs=N; of 'uuv watch': --tanks N",
    "--policy": "--agent FILE",
    "--stack": "--agent NAME, or --set stack=NAME for all agents; of 'uuv export': --out",
    "-v": "--speed",
    "--from": "uuv log import FILE",
    "--to": "uuv log convert FILE, without it",
    "warm": "uuv doctor --compile",
    "tree": "uuv presets show bt",
    "picture": "uuv log render FILE",
    "video": "uuv log render FILE --out NAME.mp4",
    "--video": "the player of 'uuv report', or 'uuv log render FILE --out NAME.mp4'",
}
"""what older versions took, and what says it now"""


def telling_new_names(app: Callable[..., Any], arguments: list[str] | None) -> Any:
    """Run the program; the refusal of an old name tells the new one."""
    try:
        return app(args=arguments, prog_name="uuv", standalone_mode=False)
    except UsageError as error:
        found = re.match(r"No such (?:option: |command ')(-*[\w-]+)|Got unexpected extra", error.message)
        takes = {p.name for p in error.ctx.command.params} if error.ctx else set()
        typed = found[1] if found else None
        now = _TODAY.get(typed) if typed else "--agent NAME|FILE" if found and "agent" in takes else None
        like = {*(getattr(error, "possibilities", None) or ())} - {"--help"}
        if now or (typed and typed.startswith("--") and "overrides" in takes and not like):
            mend = f"now it is {now}" if now else "config keys: --set KEY=VALUE"
            error.message = f"{error.message.rstrip('.')}; {mend}"
            vars(error)["possibilities"] = None  # --help, for --lr
        raise


_OF_EVERY_RESUME = ("resume", "with_report", "wide", "as_json")


def refuse_beside_resume(ctx: typer.Context, kept: tuple[str, ...] = ()) -> None:
    """UsageError for what was typed, be it a default's value, that a resumed run keeps as it was; ``kept``:
    parameters of the command that count for the rest of the run."""
    for parameter in ctx.command.params:
        name = parameter.name or ""
        source = ctx.get_parameter_source(name)
        if name in (*_OF_EVERY_RESUME, *kept) or source is None or source.name != "COMMANDLINE":
            continue
        is_option = parameter.param_type_name == "option"
        what = parameter.opts[0] if is_option else str(getattr(parameter, "metavar", "")).strip("[].")
        raise UsageError(
            f"{what} {ctx.params[name]}: a resumed run keeps its own; leave it out, or begin a new run "
            "without --resume"
        )


# ---- What may be typed where: values beside an option, names that the shell completes, refusals that say
# what was meant.

Complete = Callable[[str], list[str]]
"""From what is typed so far to what it may become."""


def choice(
    option: str, values: tuple[str, ...], help_text: str, meant: dict[str, str] | None = None, **shown: Any
) -> Any:
    """Option whose values are listed in the help, completed by the shell, and checked as soon as the command
    line is read."""

    def check(value: str | None) -> str | None:
        if value is not None and value not in values:
            close = (meant or {}).get(value) or next(
                iter(difflib.get_close_matches(value, values, n=1, cutoff=0.5)), None
            )
            hint = f"; did you mean '{close}'?" if close else ""
            raise UsageError(f"{option} {value}: use {', '.join(values[:-1])} or {values[-1]}{hint}")
        return value

    return typer.Option(
        option, metavar="|".join(values), help=help_text, callback=check,
        autocompletion=lambda incomplete: _starting(values, incomplete), **shown,
    )  # fmt: skip


def names(kind: str) -> str:
    """'gauntlet, maze, ...': the presets of a kind, for a help text."""
    return ", ".join(preset_names(kind))


def presets(kind: str, suffix: str = ".yaml") -> Complete:
    """Names of the presets of a kind, and files."""
    return lambda incomplete: _starting(preset_names(kind), incomplete) + files(suffix)(incomplete)


def agent_names(incomplete: str) -> list[str]:
    """Trees, stacks, the oracle, files and run folders; after a comma the next one."""
    before, comma, last = incomplete.rpartition(",")
    found = _starting(
        [*built_in_agents(), *(f"{tree}+truth" for tree in preset_names("tree")), "oracle"], last
    ) + _paths(
        last, lambda path: path.suffix in (".xml", ".yaml", ".py", ".onnx") or (path / "checkpoints").is_dir()
    )
    return [f"{before}{comma}{name}" for name in found]


def files(*suffixes: str) -> Complete:
    """Files with these endings."""

    return lambda incomplete: _paths(incomplete, lambda path: path.suffix in suffixes)


def grids(incomplete: str) -> list[str]:
    """Presets of grids, and the axes that have short names."""
    return _starting([*preset_names("grid"), "S=", "D=", "v=", "sensors=", "vehicle="], incomplete)


def runs(holds: str) -> Complete:
    """Folders below the one that is typed, or below ``runs``, that hold this file or folder."""

    def complete(incomplete: str) -> list[str]:
        typed = _paths(incomplete, lambda path: (path / holds).exists())
        below = [] if incomplete else _paths("runs/", lambda path: (path / holds).exists())
        return list(dict.fromkeys([*below, *typed]))

    return complete


def shown(incomplete: str) -> list[str]:
    """Every preset, and KIND/NAME of it."""
    found = {name: None for kind in KINDS for name in preset_names(kind)}
    kind, slash, _rest = incomplete.partition("/")
    if slash and kind in KINDS:
        return _starting([f"{kind}/{name}" for name in preset_names(kind)], incomplete)
    return _starting([*found, *(f"{kind}/" for kind in KINDS)], incomplete)


def _starting(words: Iterable[str], incomplete: str) -> list[str]:
    return [word for word in words if word.startswith(incomplete)]


def _paths(incomplete: str, wanted: Callable[[Path], bool]) -> list[str]:
    """Paths that begin like this: those that are ``wanted``, and folders with a slash, to be typed
    further."""
    folder, slash, start = incomplete.rpartition("/")
    try:
        entries = sorted(Path(folder or slash or ".").iterdir())
    except OSError:
        return []
    found = [path for path in entries if path.name.startswith(start) and (start or path.name[0] != ".")]
    texts = {path: f"{folder}{slash}{path.name}" for path in found}
    return [
        text if wanted(path) else f"{text}/" for path, text in texts.items() if wanted(path) or path.is_dir()
    ]
