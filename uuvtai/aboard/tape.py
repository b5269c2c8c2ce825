"""One pilot's first steps, written down: which kernels run in which order on which arguments, and LLVM's text
of each."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uuvtai.config import Config
from uuvtai.kernels.planning import route
from uuvtai.native.launch import NativeLaunch, compiling, given
from uuvtai.native.machine import Machine, tasks_in
from uuvtai.native.taichi_code import Compiler
from uuvtai.pilot import Mission, OnboardPilot
from uuvtai.pilot.sim_stack import SimStack
from uuvtai.sim import Sim
from uuvtai.stages import Stages
from uuvtai.tree import FlatTree

Line = dict[str, Any]
"""{"kernel": its number, "arguments": [..]} or {"do": what the host does}"""


@dataclass(frozen=True)
class RecordedKernel:
    """One kernel's text, and its tasks in their order."""

    name: str
    text: str
    tasks: list[str]


@dataclass
class Tape:
    """What was written down."""

    memory: np.ndarray
    """all arrays before the first step, bytes"""
    arrays: dict[str, dict[str, Any]]
    """where each lies in it, by 'struct.field'"""
    kernels: list[RecordedKernel] = field(default_factory=list)
    tensors: list[tuple[list[int], str]] = field(default_factory=list)
    """(shape, dtype) of arguments that are arrays; the first three: mask, seed and number of the episode"""
    begin: list[Line] = field(default_factory=list)
    """the first step"""
    step: list[Line] = field(default_factory=list)
    """every other one"""
    keep: list[Line] = field(default_factory=list)
    """what is launched where a route could not be planned"""


def record(config: Config, tree: FlatTree, mission: Mission) -> tuple[Tape, Sim]:
    """Run a pilot's first two steps by code that is compiled anew, and write them down; the simulator that
    has run them. UnfitError where this process compiled the same kernels before."""
    runtime_cfg = config.runtime.model_copy(update={"native": False})
    sim = Sim(config.model_copy(update={"runtime": runtime_cfg}), 1, tree)
    pilot = OnboardPilot(sim, mission)
    memory = sim.memory()
    content = memory.read()
    tape = Tape(content.copy(), _places(memory.views(content, scratch=True), content))
    told = _TapeRecorder(tape, sim)
    try:
        with told.listening(pilot):
            tape.begin = told.written(pilot.tick)
            tape.step = told.written(pilot.tick)
            tape.keep = told.written(lambda: route.keep_route(sim.io.route, 0))
    finally:
        told.compiler.close()
    return tape, sim


def _places(views: dict[str, np.ndarray], content: np.ndarray) -> dict[str, dict[str, Any]]:
    begin = content.ctypes.data
    return {
        name: {
            "shape": list(view.shape),
            "dtype": view.dtype.str,
            "offset": view.ctypes.data - begin,
            "strides": list(view.strides),
        }
        for name, view in views.items()
    }


class _TapeRecorder:
    """Stands in the place of every kernel, of the sensors and of the fallback planner."""

    def __init__(self, tape: Tape, sim: Sim) -> None:
        self.compiler = Compiler()
        self._tape, self._sim, self._machine = tape, sim, Machine(1)
        self._runtime = self._machine.runtime(sim.memory().address, alone=True)
        self._known: dict[tuple[int, ...], tuple[int, NativeLaunch]] = {}
        self._kept: list[Any] = []
        self._numbers: dict[int, int] = {}
        self._lines: list[Line] = []

    def written(self, work: Callable[[], object]) -> list[Line]:
        """What is launched meanwhile."""
        self._lines = []
        work()
        return self._lines

    def note(self, what: str) -> None:
        """What the host does at this place."""
        self._lines.append({"do": what})

    def serve(
        self,
        stages: Stages,
        seed_of: Callable[[int], int],
        read: Callable[..., Any],
        count: Callable[[Any], int],
        planner: Any = None,
    ) -> int:
        """In place of the fallback planner."""
        self.note("route")
        return 0

    def launch(self, kernel: Any, arguments: tuple) -> None:
        """In place of a kernel: its code, compiled for this processor from the text that is kept."""
        key = (id(kernel), *map(id, arguments))
        if key not in self._known:
            self._known[key] = self._compiled(kernel, arguments)
            self._kept.append((kernel, arguments))  # an identity may be given again
        number, launch = self._known[key]
        self._lines.append({"kernel": number, "arguments": self._described(kernel, arguments)})
        launch.again()

    def _compiled(self, kernel: Any, arguments: tuple) -> tuple[int, NativeLaunch]:
        with compiling(kernel, arguments):
            made = kernel.compiled_kernels[kernel.ensure_compiled(*arguments)]
            _, text = self.compiler.compiled(made)
        names = tasks_in(text)
        tasks = self._machine.tasks_of(self._machine.object_of(text), names)
        self._tape.kernels.append(RecordedKernel(kernel.func.__name__, text, names))
        launch = NativeLaunch(self._machine, self._runtime, tasks, arguments, given(kernel, arguments))
        return len(self._tape.kernels) - 1, launch

    def _described(self, kernel: Any, arguments: tuple) -> list[Any]:
        """[["int", 3], ["float", 0.5], ["array", its number]]"""
        found: list[Any] = []
        for declared, value in given(kernel, arguments):
            if declared in (int, float):
                found.append([declared.__name__, value])
                continue
            if id(value) not in self._numbers:
                self._numbers[id(value)] = len(self._tape.tensors)
                self._tape.tensors.append((list(value.shape), value.numpy().dtype.str))
            found.append(["array", self._numbers[id(value)]])
        return found

    @contextlib.contextmanager
    def listening(self, pilot: OnboardPilot) -> Iterator[None]:
        """Whatever the package launches meanwhile comes here."""
        before = [
            (module, name, value)
            for of, module in list(sys.modules.items())
            if of.startswith("uuvtai.kernels.")
            for name, value in list(vars(module).items())
            if hasattr(value, "_primal")
        ]
        place, fallback, sensors = SimStack.place, self._sim.fallback, pilot.sensors
        try:
            for module, name, value in before:
                setattr(module, name, self._teller(value._primal))
            SimStack.place = self._placing(place)  # type: ignore[method-assign]
            self._sim.fallback = self  # type: ignore[assignment]
            pilot.sensors = _ToldSensors(self, sensors)  # type: ignore[assignment]
            yield
        finally:
            for module, name, value in before:
                setattr(module, name, value)
            SimStack.place = place  # type: ignore[method-assign]
            self._sim.fallback, pilot.sensors = fallback, sensors

    def _teller(self, kernel: Any) -> Callable[..., None]:
        return lambda *arguments: self.launch(kernel, arguments)

    def _placing(self, place: Callable[..., None]) -> Callable[..., None]:
        def told(stack: SimStack, mission: Mission) -> None:
            self.note("place")
            place(stack, mission)

        return told


class _ToldSensors:
    """A pilot's sensors that say when they are asked."""

    def __init__(self, recorder: _TapeRecorder, sensors: Any) -> None:
        self._recorder, self._sensors = recorder, sensors

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._sensors, name)
        if not name.startswith("sense_"):
            return found

        def told(stages: Stages) -> None:
            self._recorder.note(name)
            found(stages)

        return told
