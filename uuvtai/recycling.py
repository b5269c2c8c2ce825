"""Arrays and bundles of closed simulators, for the next ones. Taichi gives neither the memory of fields back
nor the code that it has compiled for them, and a process can hold 512 trees of fields in all."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from uuvtai.binding import bind_all
from uuvtai.config import Config
from uuvtai.initial import allocate_state
from uuvtai.native.launch import forget
from uuvtai.stages import SimState, Stages
from uuvtai.taichi_patches.memory import Memory, address_of

_free: list[Arrays] = []


@dataclass(frozen=True)
class Arrays:
    """What a simulator has of Taichi, and what it was made for."""

    sizes: tuple[str, dict[str, int]]
    """device, and length of every axis"""
    settings: str
    """of the config that the bundles hold, as JSON"""
    s: SimState
    io: Stages
    memory: Memory

    def give_back(self) -> None:
        """Nobody uses them any more: to the system the memory, to the next simulator the rest."""
        forget(vars(self.io).values())
        self.memory.clear()
        _free.append(self)


def arrays_for(config: Config, sizes: dict[str, int], device: torch.device) -> Arrays:
    """Those of a closed simulator of these sizes, all zero; at best of one with the same config, whose
    kernels need not be compiled again. New ones where there are none."""
    settings = config.model_dump_json(include=set(Config.model_fields))
    fit = [found for found in _free if found.sizes == (device.type, sizes)]
    found = next((found for found in fit if found.settings == settings), fit[0] if fit else None)
    if found:
        _free.remove(found)
        if found.settings == settings:
            return found
    s = found.s if found else allocate_state(sizes)
    io = bind_all(Stages, s, config.model_copy(update={"world": config.world.compiled()}))
    anchor = s.clock.active
    memory = found.memory if found else Memory(s, anchor, address_of(anchor, device), device)
    return Arrays((device.type, sizes), settings, s, io, memory)
