"""Several processes train one policy: torch.distributed under ``torchrun``, gloo on the CPU and nccl on CUDA.

Every process steps its own envs on its own scenarios; gradients are averaged, sums and moments are added up,
rank 0 writes. A process without ``torchrun`` is ``Processes()``, for which all of this does nothing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, MutableMapping
from dataclasses import dataclass

import torch
import torch.distributed as dist

from uuvtai.errors import DeviceError

SEED_STRIDE = 1_000_003
"""between the env seeds of neighbouring ranks: a prime far above the seeds that people type, so that streams
of scenarios stay apart"""
_SEEDS = 2**31
_CPU = torch.device("cpu")


@dataclass(frozen=True)
class Processes:
    """Which process this is, of how many, and what they do together. Every method must be called by all of
    them in the same order."""

    rank: int = 0
    size: int = 1
    device: torch.device = _CPU

    @property
    def writes(self) -> bool:
        """Whether this is the process that writes files."""
        return self.rank == 0

    def seed(self, seed: int) -> int:
        """This rank's seed of the envs: rank 0 has the seed itself, the others' scenarios are disjoint from
        it."""
        return (seed + SEED_STRIDE * self.rank) % _SEEDS

    def average(self, tensors: Iterable[torch.Tensor]) -> None:
        """Mean over the processes, in place, in one message."""
        self._add_up(list(tensors), 1.0 / self.size)

    def total(self, tensors: Iterable[torch.Tensor]) -> None:
        """Sum over the processes, in place, in one message."""
        self._add_up(list(tensors), 1.0)

    def gather(self, tensor: torch.Tensor) -> list[torch.Tensor]:
        """Every process's tensor (equal shapes), in the order of ranks."""
        if self.size == 1:
            return [tensor]
        found = [torch.empty_like(tensor) for _ in range(self.size)]
        dist.all_gather(found, tensor.contiguous())
        return found

    def any(self, flag: bool) -> bool:
        """Whether the flag is set in any process."""
        raised = torch.tensor([float(flag)], device=self.device)
        self.total([raised])
        return bool(raised > 0)

    def mean_metrics(self, metrics: dict[str, float]) -> dict[str, float]:
        """Mean of every metric over the processes that have it; keys may differ between them."""
        if self.size == 1:
            return metrics
        text = torch.tensor(list(json.dumps(metrics).encode()), dtype=torch.uint8, device=self.device)
        lengths = [int(n) for n in self.gather(torch.tensor([len(text)], device=self.device))]
        padded = torch.zeros(max(lengths), dtype=torch.uint8, device=self.device)
        padded[: len(text)] = text
        texts = zip(self.gather(padded), lengths, strict=True)
        all_metrics = [json.loads(bytes(t[:n].tolist())) for t, n in texts]
        names = {name: None for of_rank in all_metrics for name in of_rank}
        return {name: _mean([of_rank[name] for of_rank in all_metrics if name in of_rank]) for name in names}

    def close(self) -> None:
        """Leave the group."""
        if self.size > 1 and dist.is_initialized():
            dist.destroy_process_group()

    def _add_up(self, tensors: list[torch.Tensor], factor: float) -> None:
        if self.size == 1 or not tensors:
            return
        bucket = torch.cat([t.reshape(-1) for t in tensors])
        dist.all_reduce(bucket)
        bucket *= factor
        first = 0
        for tensor in tensors:
            tensor.copy_(bucket[first : first + tensor.numel()].view_as(tensor))
            first += tensor.numel()


def is_writer(environ: Mapping[str, str] = os.environ) -> bool:
    """Whether this process will be the one that writes files, known before it has joined the others."""
    return environ.get("WORLD_SIZE", "1") == "1" or environ.get("RANK", "0") == "0"


def claim_gpu(environ: MutableMapping[str, str] = os.environ) -> None:
    """Under torchrun, show this process its own GPU only: by LOCAL_RANK, among those of CUDA_VISIBLE_DEVICES
    where that is set.

    Taichi always takes the first GPU it sees, so call this once, before Taichi or CUDA starts. RuntimeError
    where it is too late, or where CUDA_VISIBLE_DEVICES names fewer GPUs than there are processes. An empty
    CUDA_VISIBLE_DEVICES (no GPU wanted) stays.
    """
    local, visible = environ.get("LOCAL_RANK"), environ.get("CUDA_VISIBLE_DEVICES")
    if local is None or visible == "":
        return
    if torch.cuda.is_initialized():
        raise RuntimeError("CUDA has started before this process chose its GPU; call claim_gpu() first")
    if visible is None:  # asking CUDA how many there are would start it
        environ["CUDA_VISIBLE_DEVICES"] = local
        return
    gpus = visible.split(",")
    if int(local) >= len(gpus):
        raise DeviceError(
            f"process {local} of this machine has no GPU: CUDA_VISIBLE_DEVICES={visible} names {len(gpus)}; "
            f"type torchrun --nproc-per-node={len(gpus)}"
        )
    environ["CUDA_VISIBLE_DEVICES"] = gpus[int(local)]


def join_processes(device: torch.device | str = "cpu") -> Processes:
    """Join the group that torchrun set up (RANK, WORLD_SIZE, MASTER_ADDR, MASTER_PORT); without torchrun, the
    one process there is."""
    device = torch.device(device)
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        return Processes(device=device)
    if not dist.is_initialized():
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return Processes(dist.get_rank(), size, device)


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
