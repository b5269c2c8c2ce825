"""The steps of a reproduction: each one command of ours in its own folder, named by its figures."""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from uuvtai.common.files import FileError, read_json
from uuvtai.logs.run_folder import RunFolderError, write_atomic

TRAINED = ("ppo", "distill_20", "curriculum", "no_risk_scaling", "no_world_model")
"""presets that are trained; in the ablation's table ``curriculum`` is "Full" and ``ppo`` is "BT distill\""""
EVALUATION_SEED = 90009
"""never trained or tuned on; for published figures alone: do not look while you change things"""
RETIRED_SEEDS = range(90001, 90009)  # test seeds of old that tuning has met since (``research/LOG.md``)


@dataclass(frozen=True)
class Budget:
    iterations: int
    """of 256 envs x 64 steps; 38 are 622,592 env-steps, the paper's budget, and 380 ten times as many"""
    training_seeds: int
    episodes: int  # per agent in Table main
    ceiling_episodes: int
    sweep_episodes: int  # per cell
    profile_seconds: float
    beyond: bool  # also trade-off, robustness and gauntlet sweeps


BUDGETS = {
    "quick": Budget(38, 1, 200, 40, 8, 4.0, beyond=False),
    "full": Budget(380, 3, 1000, 200, 64, 10.0, beyond=True),
}


@dataclass(frozen=True)
class Step:
    """One command. ``folder`` is relative to the reproduction's."""

    name: str
    command: tuple[str, ...]  # arguments of ``uuv``, without folder
    folder: str
    resumes: bool = False  # what was begun is gone on with by ``--resume``; other commands begin anew
    to_file: bool = False  # the command has no run folder: what it prints is kept

    def argv(self, root: Path, resume: bool = False) -> list[str]:
        """Arguments of ``uuv`` with the folder, as they are run."""
        place = str(root / self.folder)
        if resume:  # whoever began or goes on with the reproduction has agreed to the code that it names
            allowed = ["--allow-code"] if self.command[0] == "sweep" else []
            return [self.command[0], "--resume", place, *allowed, "--json"]
        return [*self.command, *([] if self.to_file else ["--run-dir", place]), "--json"]


def steps_of(budget: Budget, root: Path, own: Sequence[str] = ()) -> list[Step]:
    """All steps in their order; ``own``: plugins of the user's, beside ours wherever agents are compared."""
    seeds = range(budget.training_seeds)
    runs = {preset: [f"train/{preset}-{seed}" for seed in seeds] for preset in TRAINED}
    trainings = [
        Step(
            f"train {preset}, seed {seed}",
            _train(preset, seed, budget),
            f"train/{preset}-{seed}",
            resumes=True,
        )
        for seed in seeds
        for preset in TRAINED
    ]
    at = ("--seeds", str(EVALUATION_SEED), "--episodes")
    places = [str(root / place) for of_preset in runs.values() for place in of_preset]
    agent = str(root / runs["curriculum"][0])
    judged = ("eval", *_agents("straight", "planner", "bt", *own, *places), *at, str(budget.episodes))
    recorded = ("--record", "1", *at, "1")
    agents = [str(root / runs[name][0]) for name in ("ppo", "distill_20", "curriculum")]
    steps = [
        *trainings,
        Step("Table main and ablations", judged, "eval/main"),
        Step(
            "ceilings",
            ("eval", *_agents("bt", "bt+truth", "oracle"), *at, str(budget.ceiling_episodes)),
            "eval/ceilings",
        ),
        Step(
            "transfer",
            ("eval", *_agents("bt", *own, agent), "--world", "transfer", *at, str(budget.episodes)),
            "eval/transfer",
        ),
        Step("scenario A", ("eval", *_agents("bt", *own, *agents), *recorded, "--video"), "eval/scenario_a"),
        Step(
            "scenario B",
            ("eval", *_agents("bt", *own, *agents), "-S", "12", "-D", "9", *recorded, "--video"),
            "eval/scenario_b",
        ),
        Step("sweep", _sweep(agent, "paper", budget.sweep_episodes, own=own), "sweep/pool", resumes=True),
        Step(
            "profile",
            ("profile", "--num-envs", "1,64,1024", "--seconds", str(budget.profile_seconds), "--density"),
            "profile",
            to_file=True,
        ),
    ]
    return steps + (_beyond(agent, budget, own) if budget.beyond else [])


def _train(preset: str, seed: int, budget: Budget) -> tuple[str, ...]:
    return ("train", preset, "--seed", str(seed), "--set", f"train.iterations={budget.iterations}")


def _sweep(agent: str, grid: str, episodes: int, *more: str, own: Sequence[str] = ()) -> tuple[str, ...]:
    seed = ("--seeds", str(EVALUATION_SEED))
    return ("sweep", *_agents("bt", *own, agent), "--grid", grid, "--episodes", str(episodes), *seed, *more)


def _beyond(agent: str, budget: Budget, own: Sequence[str]) -> list[Step]:
    few = max(1, budget.sweep_episodes // 2)
    return [
        Step(
            "gauntlet",
            _sweep(agent, "paper", few, "--world", "gauntlet", own=own),
            "sweep/gauntlet",
            resumes=True,
        ),
        Step(
            "trade-off",
            ("sweep", *_agents("bt"), "--grid", "caution", "--episodes", str(few)),
            "sweep/caution",
            resumes=True,
        ),
        Step(
            "robustness",
            _sweep(agent, "robustness", 4 * budget.sweep_episodes, own=own),
            "sweep/robustness",
            resumes=True,
        ),
        Step(
            "dead reckoning",
            _sweep(agent, "dead_reckoning", 4 * budget.sweep_episodes, own=own),
            "sweep/dead_reckoning",
            resumes=True,
        ),
    ]


def _agents(*names: str) -> tuple[str, ...]:
    return tuple(part for name in names for part in ("--agent", name))


# ---------------------------------------------------------------------------------------------------- running


def is_done(step: Step, root: Path) -> bool:
    if step.to_file:
        return result_file(step, root).exists()
    try:
        return read_json(root / step.folder / "run.json", folder=root)["status"] == "finished"
    except (FileError, OSError, KeyError, TypeError):
        return False


def result_file(step: Step, root: Path) -> Path:
    """Where the JSON document lies that the step's command prints."""
    return root / step.folder / ("profile.json" if step.to_file else "stdout.json")


_INTERRUPTED = (130, 143, -signal.SIGINT, -signal.SIGTERM)


def run_step(step: Step, root: Path) -> None:
    """Run what is not done; what was begun goes on. KeyboardInterrupt, RunFolderError as commands end."""
    place = root / step.folder
    begun = place.exists() and any(place.iterdir())
    written = "checkpoints/step_*" if step.command[0] == "train" else "sweep_request.json"
    resume = begun and step.resumes and any(place.glob(written))
    if begun and not resume:
        shutil.rmtree(place)
    done = launch(step.argv(root, resume))
    if done.returncode in _INTERRUPTED:
        raise KeyboardInterrupt
    if done.returncode:
        raise RunFolderError(
            f"{step.name}: 'uuv {' '.join(step.argv(root, resume))}' ended with {done.returncode}; its "
            "message is above"
        )
    write_atomic(result_file(step, root), done.stdout)


def launch(arguments: list[str]) -> subprocess.CompletedProcess[bytes]:
    """Run ``uuv`` in a process of its own; what it prints is kept, its messages go where ours go."""
    command = [sys.executable, "-m", "uuvtai", *arguments]
    before = _die_with_parent if os.name == "posix" else None
    # a session of its own: what a terminal tells us it hears once, from us, and can save
    child = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        preexec_fn=before,  # noqa: PLW1509
        start_new_session=True,
    )
    try:
        printed, _ = child.communicate()
    except KeyboardInterrupt:
        child.terminate()
        child.communicate()  # it saves what it keeps
        raise
    return subprocess.CompletedProcess(command, child.returncode, printed)


def _die_with_parent() -> None:
    """A killed reproduction leaves no training behind to fight the next one (Linux; else it runs on)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
