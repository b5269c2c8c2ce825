"""A training run: its folder, going on bit for bit, interrupts, failures, evaluations without a trace."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.command import uuv
from tests.point_env import PointEnv
from tests.small_sim import SmallSim
from uuvtai.common.errors import OwnCodeError
from uuvtai.config.loader import ConfigError, load_config, load_training
from uuvtai.envs.vector_env import VectorEnv
from uuvtai.evaluation.evaluate import evaluate_now
from uuvtai.learning import checkpoint
from uuvtai.learning import runner as training
from uuvtai.learning.checkpoint import pack
from uuvtai.learning.environments import Simulated
from uuvtai.learning.networks import TrainingError
from uuvtai.learning.runner import TrainRequest, read_metrics
from uuvtai.learning.trainer import Trainer
from uuvtai.logs.run_folder import RunFolder, RunFolderError
from uuvtai.plugins.api import PluginSpec

TINY = {
    "policy.hidden": [8, 8], "world_model.hidden": [8], "world_model.latent": 4,
    "ppo.rollout_steps": 8,
    "ppo.epochs": 1, "train.evaluate_every": 0, "train.checkpoint_every": 2,
}  # fmt: skip


class Quiet:
    """Watches without a word; ``press_at``: iteration after which somebody presses Ctrl-C."""

    def __init__(self, press_at=None, times=1):
        self.press_at, self.times, self.notes, self.rows = press_at, times, [], []

    def start(self, folder, config, done, total):
        self.began = (done, total)

    def note(self, text):
        self.notes.append(text)

    def update(self, done, metrics, success_ci95):
        self.rows.append((done, metrics, success_ci95))
        for _ in range(self.times if done == self.press_at else 0):
            signal.raise_signal(signal.SIGINT)

    def stop(self):
        pass


@pytest.fixture
def points(monkeypatch):
    """Training drives points instead of vehicles; what it made is told."""
    made = []
    monkeypatch.setattr(training, "_env", lambda config, _device: made.append(PointEnv(8)) or made[-1])
    monkeypatch.setattr(os, "fsync", lambda _descriptor: None)  # takes its time, and tests nothing here
    return made


def config_of(**overrides):
    return load_training("smoke", TINY | {key.replace("__", "."): value for key, value in overrides.items()})


def train(request, watch):
    return training.train(request, watch, evaluate_now)


def run_json(folder):
    return json.loads((folder / "run.json").read_text())


def content_of(path):
    """Every file of a checkpoint that holds state."""
    return {p.name: p.read_bytes() for p in path.iterdir() if p.name != "manifest.json"}


def notes(folder):
    """The metrics of a run, but for wall times."""
    return [
        {
            name: value
            for name, value in row.items()
            if not name.startswith("time/") or name == "time/env_steps"
        }
        for row in read_metrics(folder)
    ]


def test_a_run_leaves_a_complete_folder(points, tmp_path):
    watch = Quiet()
    document, folder = train(TrainRequest(config=config_of(), run_dir=tmp_path / "run"), watch)
    assert (document["iterations"], document["run"]) == (6, str(folder))
    assert (run_json(folder)["status"], run_json(folder)["exit"]) == ("finished", 0)
    assert (
        [row["iteration"] for row in read_metrics(folder)]
        == [1, 2, 3, 4, 5, 6]
        == [row[0] for row in watch.rows]
    )
    assert list((folder / "tensorboard").glob("events.*"))
    assert sorted(p.name for p in (folder / "checkpoints").iterdir()) == [
        "step_000002",
        "step_000004",
        "step_000006",
    ]
    assert checkpoint.newest(folder).config == config_of()
    rates = [(metrics.get("rollout/success_rate"), interval) for _, metrics, interval in watch.rows]
    assert all((rate is None) == (interval is None) for rate, interval in rates)
    assert all(interval[0] <= rate <= interval[1] for rate, interval in rates if rate is not None)


def test_a_run_goes_on_to_as_many_iterations_as_it_began_with(points, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train(TrainRequest(config=config_of(), run_dir=run, iterations=9), Quiet(press_at=7))
    document, _ = train(TrainRequest(resume=run), watch := Quiet())
    assert document["iterations"] == 9 and watch.began[1] == 9
    document, _ = train(TrainRequest(resume=run, iterations=10), Quiet())
    assert document["iterations"] == run_json(run)["iterations"] == 10


def test_an_interrupt_finishes_the_iteration_and_saves(points, tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    watch = Quiet(press_at=3)
    with pytest.raises(KeyboardInterrupt):
        train(TrainRequest(config=config_of(), run_dir=cut), watch)
    assert (run_json(cut)["status"], run_json(cut)["exit"]) == ("interrupted", 130)
    assert checkpoint.newest(cut, resumable=True).step >= 3
    assert f"uuv train --resume {cut}" in watch.notes[-1]
    train(TrainRequest(resume=cut), Quiet())
    train(TrainRequest(config=config_of(), run_dir=whole), Quiet())
    assert content_of(whole / "checkpoints/step_000006") == content_of(cut / "checkpoints/step_000006")
    assert notes(whole) == notes(cut)
    assert run_json(cut)["status"] == "finished" and len(run_json(cut)["resumed"]) == 1


def test_a_second_interrupt_stops_at_once(points, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        train(TrainRequest(config=config_of(), run_dir=tmp_path / "run"), Quiet(press_at=3, times=2))
    assert run_json(tmp_path / "run")["status"] == "interrupted"
    assert checkpoint.newest(tmp_path / "run").step == 2, "the last one that was due"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_failed_run_is_marked_and_keeps_its_checkpoints(points, tmp_path):
    class Poisoned(Quiet):
        def update(self, done, metrics, success_ci95):
            if done == 2:
                points[-1].poison = {"reward"}

    config = config_of(train__patience=2)
    with pytest.raises(TrainingError, match="not finite"):
        train(TrainRequest(config=config, run_dir=tmp_path / "run"), Poisoned())
    assert (run_json(tmp_path / "run")["status"], run_json(tmp_path / "run")["exit"]) == ("failed", 1)
    assert checkpoint.newest(tmp_path / "run", resumable=True).step == 2


def test_what_was_learned_before_a_reward_failed_is_kept(points, tmp_path):
    """Also where no checkpoint was due."""

    class Failing(Quiet):
        def update(self, done, metrics, success_ci95):
            if done == 3:
                points[-1].step = self.fail

        def fail(self, *_):
            raise OwnCodeError("mine.py:3: terms: near is nan in env 0")

    watch = Failing()
    own = SimpleNamespace(spec=PluginSpec("reward", Path("my own.py"), "terms"), sha256="0", reward=id)
    config = config_of(train__checkpoint_every=100)
    with pytest.raises(OwnCodeError, match="near is nan"):
        train(TrainRequest(config=config, run_dir=tmp_path / "run", iterations=5, reward=own), watch)
    typed = f"--start {tmp_path}/run --reward 'my own.py:terms' --iterations 5"
    assert watch.notes[-1] == f"saved; mend the reward, then: uuv train PRESET {typed}"
    assert checkpoint.newest(tmp_path / "run").step == 3


def test_a_damaged_checkpoint_is_told_and_the_one_before_goes_on(points, tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    train(TrainRequest(config=config_of(), run_dir=cut, iterations=4), Quiet())
    with (cut / "checkpoints/step_000004/training.safetensors").open("r+b") as file:
        file.truncate(100)
    watch = Quiet()
    train(TrainRequest(resume=cut, iterations=6), watch)
    assert any("was cut off" in text for text in watch.notes)
    assert watch.began == (2, 6)
    train(TrainRequest(config=config_of(), run_dir=whole), Quiet())
    assert content_of(whole / "checkpoints/step_000006") == content_of(cut / "checkpoints/step_000006")
    assert notes(whole) == notes(cut)


def test_settings_may_change_as_a_run_goes_on(points, tmp_path):
    train(TrainRequest(config=config_of(), run_dir=tmp_path / "run", iterations=2), Quiet())
    train(TrainRequest(resume=tmp_path / "run", overrides=["ppo.learning_rate=1e-5"]), Quiet())
    assert checkpoint.newest(tmp_path / "run").config.ppo.learning_rate == 1e-5
    assert "learning_rate: 1.0e-05" in (tmp_path / "run" / "config.yaml").read_text()


def test_a_run_that_cannot_go_on_says_why_and_loses_nothing(points, tmp_path, monkeypatch):
    run = tmp_path / "run"
    train(TrainRequest(config=config_of(), run_dir=run, iterations=2), Quiet())
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    for request, error, says in (
        (
            TrainRequest(resume=run, iterations=2),
            ConfigError,
            "has done 2 of 2 iterations; to go on give more: --iterations 4",
        ),
        (TrainRequest(resume=run, iterations=0), ConfigError, "at least 1"),
        (TrainRequest(resume=tmp_path), RunFolderError, "is no run folder"),
        (TrainRequest(resume=run, overrides=["ppo.gama=1"]), ConfigError, "did you mean 'gamma'"),
        (TrainRequest(resume=run, overrides=["policy.hidden=[4]"]), RuntimeError, "size mismatch"),
        (TrainRequest(config=config_of(), run_dir=run), RunFolderError, "already there and not empty"),
    ):
        with pytest.raises(error, match=says):
            train(request, Quiet())
    other = PointEnv(8)
    other.observation_table = other.observation_table[::-1]
    monkeypatch.setattr(training, "_env", lambda _config, _device: other)
    with pytest.raises(checkpoint.CheckpointError, match="another observation table"):
        train(TrainRequest(resume=run), Quiet())
    assert {p: p.read_bytes() for p in run.rglob("*") if p.is_file()} == before


def test_a_stranger_to_start_with_is_refused_before_its_networks_are_made(points, tmp_path, monkeypatch):
    run = tmp_path / "run"
    train(TrainRequest(config=config_of(), run_dir=run, iterations=2), Quiet())
    found = checkpoint.newest(run)
    policy = found.config.policy.model_copy(update={"hidden": (10**7, 10**7)})  # 400 TB
    wide = dataclasses.replace(found, config=found.config.model_copy(update={"policy": policy}))
    monkeypatch.setattr(training, "find_policy", lambda _name, _note: wide)
    request = TrainRequest(config=config_of(), run_dir=tmp_path / "other", start=run)
    with pytest.raises(checkpoint.CheckpointError, match="not those of its config"):
        train(request, Quiet())
    assert not (tmp_path / "other").exists()


def test_an_evaluation_is_no_training_run(tmp_path):
    RunFolder(tmp_path / "run", load_config("pool"), [0])
    with pytest.raises(ConfigError, match="is no training run"):
        train(TrainRequest(resume=tmp_path / "run"), Quiet())


def test_two_processes_do_not_train_in_one_folder(points, tmp_path):
    train(TrainRequest(config=config_of(), run_dir=tmp_path / "run", iterations=2), Quiet())
    script = """if True:
        import sys
        from pathlib import Path
        from uuvtai.logs.run_folder import RunFolder
        folder = RunFolder.__new__(RunFolder)
        folder.path = Path(sys.argv[1])
        folder.hold()
        print("held", flush=True)
        sys.stdin.read()
    """
    holder = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path / "run")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(RunFolderError, match="another process is working in this folder"):
        train(TrainRequest(resume=tmp_path / "run"), Quiet())
    holder.communicate()
    train(TrainRequest(resume=tmp_path / "run"), Quiet())


# --------------------------------------------------------------------------------------------- the real thing


def test_an_evaluation_in_between_leaves_no_trace(small):
    """Training shares its simulator with the evaluation, and goes on as if nothing had been."""
    scenes = [[8, 6, 0.6], [3, 0, 0.6], [8, 9, 1.5]]
    config = load_training(
        "smoke", TINY | {"world.dynamic_capacity": 9, "train.evaluate_episodes": 2, "train.scenes": scenes}
    )
    states = []
    small.sim.set_scenes(config.train.scenes)
    for is_evaluated in (False, True):
        trainer = Trainer(Simulated(VectorEnv(small.sim), config), config)
        with torch.no_grad():
            trainer.policy.actor[-1].bias[2] = 3.0  # down or up until something stops it: short episodes
        trainer.iterate()
        if is_evaluated:
            found = evaluate_now(trainer, config)
            assert found["eval/success_rate"] == 0.0
            assert found["eval/collision_rate"] == 1.0
        trainer.iterate()
        states.append(pack(trainer.state()))
    dealt = small.sim.s.scene.n_dynamic.to_numpy().tolist()
    small.sim.set_scenes()
    assert dealt[:4] == [6, 0, 9, 6]
    (plain, tensors), (other_plain, other) = states
    assert plain == other_plain
    assert all(
        torch.equal(tensor.view(-1).view(torch.uint8), other[name].view(-1).view(torch.uint8))
        for name, tensor in tensors.items()
    )


RUN = (*SmallSim.TRAIN, "--set", "train.iterations=3", "--set", "train.checkpoint_every=1")
LONGEST_S = 900.0
"""kernels that are not compiled yet take minutes on a busy machine"""


def killed_between_checkpoints(folder, *arguments):
    """Run a training in another process and kill it as soon as it has written two checkpoints."""
    command = [sys.executable, "-m", "uuvtai", *arguments, "--run-dir", str(folder)]
    with subprocess.Popen(
        command, stderr=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"}
    ) as process:
        deadline = time.monotonic() + LONGEST_S
        while (
            len(list((folder / "checkpoints").glob("step_*"))) < 2
            and process.poll() is None
            and time.monotonic() < deadline
        ):
            time.sleep(0.01)
        process.kill()


@pytest.fixture
def one_thread():
    """As in the process above: what threads sum up depends on how many they are."""
    usual = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(usual)


def test_a_killed_run_goes_on_bit_for_bit_in_another_process(one_thread, tmp_path, capfd):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    killed_between_checkpoints(killed, *RUN)
    assert run_json(killed)["status"] == "running", "nobody was there to say otherwise"
    assert checkpoint.newest(killed, resumable=True).step == 2
    assert uuv(capfd, "train", "--resume", killed, "--device", "cpu")[0] == 0
    code, out, err = uuv(capfd, *RUN, "--run-dir", whole, "--json")
    assert code == 0 and json.loads(out)["iterations"] == 3
    assert "3/3: success" in err
    assert content_of(whole / "checkpoints/step_000003") == content_of(killed / "checkpoints/step_000003")
    assert notes(whole) == notes(killed)
