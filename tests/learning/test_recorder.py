"""The record of a run: every iteration once, also after a resume, and the same numbers for TensorBoard."""

import json

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.summary.writer import event_file_writer

from uuvtai.learning.runner import MetricsRecorder, read_metrics


def record(run, done, iterations, factor=1.0):
    recorder = MetricsRecorder(run, done)
    for i in iterations:
        recorder.write(i, {"rollout/ep_rew_mean": factor * i, "train/policy_loss": -0.5})
    recorder.close()


def test_every_iteration_is_a_line_and_an_event(tmp_path):
    record(tmp_path, 0, (1, 2, 3))
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert lines == [
        {"iteration": i, "rollout/ep_rew_mean": float(i), "train/policy_loss": -0.5} for i in (1, 2, 3)
    ]
    assert read_metrics(tmp_path) == lines
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert sorted(events.Tags()["scalars"]) == ["rollout/ep_rew_mean", "train/policy_loss"]
    assert [(e.step, e.value) for e in events.Scalars("rollout/ep_rew_mean")] == [
        (1, 1.0),
        (2, 2.0),
        (3, 3.0),
    ]


def test_lines_are_readable_while_the_run_goes_on(tmp_path):
    recorder = MetricsRecorder(tmp_path)
    recorder.write(1, {"a": 1.0})
    assert read_metrics(tmp_path) == [{"iteration": 1, "a": 1.0}]
    recorder.close()


def test_events_are_read_in_the_order_of_the_resumes(tmp_path, monkeypatch):
    """A name ends in a count, and names are sorted as text: 10 before 9."""
    monkeypatch.setattr(event_file_writer, "_global_uid", event_file_writer.AtomicCounter(9))
    record(tmp_path, 0, (1, 2))
    record(tmp_path, 1, (2, 3))
    assert {path.name.rpartition(".")[2] for path in (tmp_path / "tensorboard").iterdir()} == {"9", "10"}
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [e.step for e in events.Scalars("rollout/ep_rew_mean")] == [1, 2, 3]


@pytest.mark.parametrize("cut_off", ["", '{"iteration": 5, "rollo', "{}\n", "\x00\x00"])
def test_a_resumed_run_forgets_what_came_after_its_checkpoint(tmp_path, cut_off):
    record(tmp_path, 0, (1, 2, 3, 4))
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write(cut_off)
    assert [row["iteration"] for row in read_metrics(tmp_path)] == [1, 2, 3, 4]
    record(tmp_path, 2, (3, 4, 5), factor=10.0)
    assert [row["rollout/ep_rew_mean"] for row in read_metrics(tmp_path)] == [1.0, 2.0, 30.0, 40.0, 50.0]
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("rollout/ep_rew_mean")] == [
        (1, 1.0), (2, 2.0), (3, 30.0), (4, 40.0), (5, 50.0),
    ]  # fmt: skip


def test_what_is_not_finite_is_null_and_no_event(tmp_path):
    recorder = MetricsRecorder(tmp_path)
    recorder.write(1, {"a": float("nan"), "b": float("inf"), "c": 1.0})
    recorder.close()
    assert read_metrics(tmp_path) == [{"iteration": 1, "a": None, "b": None, "c": 1.0}]
    assert EventAccumulator(str(tmp_path / "tensorboard")).Reload().Tags()["scalars"] == ["c"]
