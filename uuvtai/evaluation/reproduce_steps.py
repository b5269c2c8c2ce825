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

METHODS = ("paper", "ppo", "constant_20", "no_risk_scaling", "no_world_model")
"""presets that are trained; in the ablation's table ``paper`` is "Full" and ``ppo`` is "BT distill\""""
_TEN_HZ, _HOLD_STEPS = "_10hz", 5  # methods whose decisions last five control steps, on as many env-steps
ENV_STEPS = 512  # of an iteration: 8 envs x 64 decisions at 50 Hz
EVALUATION_SEED = 90010
"""never trained or tuned on; for published figures alone: do not look while you change things"""
RETIRED_SEEDS = range(90001, 90010)  # test seeds of old that tuning has met since (``research/LOG.md``)


@dataclass(frozen=True)
class Budget:
    iterations: int
    """the paper's 1,200 are 614,400 env-steps"""
    training_seeds: int
    episodes: int  # per agent in Table main
    methods: tuple[str, ...] = (*METHODS, f"paper{_TEN_HZ}", f"ppo{_TEN_HZ}")
    sweep_episodes: int = 0
    """per cell; 0 = trainings and Table main alone"""
    profile_seconds: float = 0.0

    def runs(self, method: str) -> list[str]:
        """Folders of a method's trainings, by training seed."""
        return [f"train/{method}-{seed}" for seed in range(self.training_seeds)]


BUDGETS = {
    "quick": Budget(120, 2, 100, sweep_episodes=8, profile_seconds=4.0),
    "paper": Budget(1200, 5, 500, sweep_episodes=64, profile_seconds=10.0),
    "tenfold": Budget(12_000, 3, 500, METHODS[:3]),
}


@dataclass(frozen=True)
class Step:
    """One command. ``folder`` is relative to the reproduction's."""

    name: str
    command: tuple[str, ...]  # arguments of ``uuv``, without folder
    folder: str
    resumes: bool = False  # what was begun is gone on with by ``--resume``; other commands begin anew
    to_file: bool = False  # the command has no run folder: what it prints is kept
    row: str = ""
    """the training that it makes or evaluates; once the row of that is written, nothing is left to do"""

    def argv(self, root: Path, resume: bool = False) -> list[str]:
        """Arguments of ``uuv`` with the folder, as they are run."""
        place = str(root / self.folder)
        if resume:  # whoever began or goes on with the reproduction has agreed to the code that it names
            allowed = ["--allow-code"] if self.command[0] == "sweep" else []
            return [self.command[0], "--resume", place, *allowed, "--json"]
        return [*self.command, *([] if self.to_file else ["--run-dir", place]), "--json"]


def steps_of(budget: Budget, root: Path, own: Sequence[str] = ()) -> list[Step]:
    """All steps in their order; ``own``: plugins of the user's, beside ours wherever agents are compared.

    Everything drives on the paper's stack, on which the policies were trained. A training is evaluated as it
    was at its end: the presets choose no checkpoint by its success.
    """
    at = ("--set", "stack=paper", "--seeds", str(EVALUATION_SEED), "--episodes")
    main = ("eval", *_agents("straight", "planner", "bt", *own), *at, str(budget.episodes))
    steps = [Step("agents that are not trained", main, "eval/main")]
    for seed in range(budget.training_seeds):
        for method in budget.methods:
            place, name = budget.runs(method)[seed], f"{method}-{seed}"
            training = _train(method, seed, budget.iterations)
            judged = ("eval", *_agents(str(root / place)), *at, str(budget.episodes))
            steps.append(Step(f"train {method}, seed {seed}", training, place, resumes=True, row=name))
            steps.append(Step(f"evaluate {method}, seed {seed}", judged, f"eval/{name}", row=name))
    return steps + (_beside_training(budget, root, own, at) if budget.sweep_episodes else [])


def _train(method: str, seed: int, iterations: int) -> tuple[str, ...]:
    preset, slow, _ = method.partition(_TEN_HZ)
    held = ("--set", f"policy.hold_steps={_HOLD_STEPS}") if slow else ()
    rounds = iterations // _HOLD_STEPS if slow else iterations
    return ("train", preset, "--seed", str(seed), *held, "--set", f"train.iterations={rounds}")


def _beside_training(budget: Budget, root: Path, own: Sequence[str], at: tuple[str, ...]) -> list[Step]:
    """The distilled policy in another scene and in other conditions, trajectories, times."""
    policies = [str(root / budget.runs(method)[0]) for method in METHODS[:3]]
    distilled, few = policies[0], str(budget.sweep_episodes)
    recorded = ("eval", *_agents("bt", *own, *policies), "--record", "1", *at, "1")
    moved = ("eval", *_agents("bt", *own, distilled), "--world", "transfer", *at, str(budget.episodes))
    swept = ("sweep", *_agents("bt", *own, distilled), "--grid", "paper", *at, few)
    timed = ("profile", "--num-envs", "1,64,1024", "--seconds", str(budget.profile_seconds), "--density")
    return [
        Step("transfer", moved, "eval/transfer"),
        Step("scenario A", recorded, "eval/scenario_a"),
        Step("scenario B", (*recorded, "-S", "12", "-D", "9"), "eval/scenario_b"),
        Step("sweep", swept, "sweep/pool", resumes=True),
        Step("profile", timed, "profile", to_file=True),
    ]


def _agents(*names: str) -> tuple[str, ...]:
    return tuple(part for name in names for part in ("--agent", name))


# ---------------------------------------------------------------------------------------------------- running


def is_done(step: Step, root: Path) -> bool:
    """Whether nothing is left to run. A training may have been made beforehand by its own command: it leaves
    in its folder all that counts."""
    if step.row and row_file(root, step.row).exists():
        return True
    if step.command[0] != "train" and not result_file(step, root).exists():
        return False
    try:
        record = {} if step.to_file else read_json(root / step.folder / "run.json", folder=root)
        return step.to_file or record["status"] == "finished"
    except (FileError, OSError, KeyError, TypeError):
        return False


def row_file(root: Path, name: str) -> Path:
    """Where lies what counts of a training and its evaluation: all that a reproduction elsewhere needs."""
    return root / "rows" / f"{name}.json"


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
