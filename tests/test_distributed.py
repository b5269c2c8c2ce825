"""Two processes over gloo: sums, means, metrics and seeds; which GPU a process takes."""

import multiprocessing
import os
import socket

import pytest
import torch

from uuvtai.learn.distributed import Processes, claim_gpu, join_processes


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def in_process(rank, port, work, answers):
    torch.set_num_threads(1)
    os.environ.update(
        RANK=str(rank), LOCAL_RANK=str(rank), WORLD_SIZE="2", MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port)
    )
    processes = join_processes()
    try:
        answers.put((rank, work(processes)))
    finally:
        processes.close()


def two(work):
    """What ``work(processes)`` returns in rank 0 and in rank 1; neither process starts Taichi."""
    context = multiprocessing.get_context("spawn")
    answers, port = context.Queue(), free_port()
    children = [context.Process(target=in_process, args=(rank, port, work, answers)) for rank in range(2)]
    for child in children:
        child.start()
    found = dict(answers.get(timeout=120) for _ in children)
    for child in children:
        child.join(timeout=60)
        assert child.exitcode == 0
    return found[0], found[1]


def exchange(processes):
    r = float(processes.rank)
    mean, total = (
        [torch.tensor([r, 2.0]), torch.full((2, 2), r)],
        [torch.tensor([r + 1], dtype=torch.float64)],
    )
    processes.average(mean)
    processes.total(total)
    metrics = processes.mean_metrics({"both": r, f"only_{processes.rank}": 5.0})
    gathered = [t.tolist() for t in processes.gather(torch.tensor([r]))]
    any_one = processes.any(processes.rank == 1), processes.any(False)
    return [t.tolist() for t in mean], total[0].tolist(), metrics, gathered, any_one, processes.writes


def test_two_processes_exchange():
    first, second = two(exchange)
    assert first[:-1] == second[:-1]
    mean, total, metrics, gathered, any_one, writes = first
    assert mean == [[0.5, 2.0], [[0.5, 0.5], [0.5, 0.5]]]
    assert total == [3.0]
    assert metrics == {"both": 0.5, "only_0": 5.0, "only_1": 5.0}
    assert gathered == [[0.0], [1.0]]
    assert any_one == (True, False)
    assert writes and not second[-1]


def test_one_process_needs_no_group(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    alone = join_processes()
    tensor = torch.tensor([3.0])
    alone.average([tensor])
    alone.total([tensor])
    assert tensor.tolist() == [3.0] and alone.gather(tensor) == [tensor]
    assert alone.mean_metrics({"a": 1.0}) == {"a": 1.0}
    assert alone.any(True) and not alone.any(False) and alone.writes
    alone.close()


def test_every_rank_has_scenarios_of_its_own():
    seeds = [Processes(rank, 64).seed(7) for rank in range(64)]
    assert seeds[0] == 7 and len(set(seeds)) == 64
    assert not set(seeds[1:]) & set(range(1000)), "the seeds that people type belong to one process"
    assert all(0 <= Processes(rank, 64).seed(2**31 - 1) < 2**31 for rank in range(64))


@pytest.mark.parametrize(
    ("environ", "gpu"),
    [
        ({}, None),
        ({"LOCAL_RANK": "1"}, "1"),
        ({"LOCAL_RANK": "1", "CUDA_VISIBLE_DEVICES": "4,6"}, "6"),
        ({"LOCAL_RANK": "1", "CUDA_VISIBLE_DEVICES": ""}, ""),
        ({"CUDA_VISIBLE_DEVICES": "3"}, "3"),
    ],
)
def test_a_process_takes_its_own_gpu(environ, gpu):
    claim_gpu(environ)
    assert environ.get("CUDA_VISIBLE_DEVICES") == gpu


def test_too_few_gpus_are_an_error_that_says_what_to_type():
    with pytest.raises(RuntimeError, match="--nproc-per-node=2"):
        claim_gpu({"LOCAL_RANK": "2", "CUDA_VISIBLE_DEVICES": "0,1"})


def test_choosing_a_gpu_too_late_is_an_error(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    with pytest.raises(RuntimeError, match="before"):
        claim_gpu({"LOCAL_RANK": "0"})
