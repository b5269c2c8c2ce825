"""``uuv export LOG``: the stack of a log as a folder that drives without Taichi and torch, written whole
or not at all."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import io
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.common.errors import UserError
from uuvtai.common.files import whole_folder
from uuvtai.common.version import __version__
from uuvtai.compile.codegen import Compiler, UnfitError, completed, emitted, runtime_layout, tasks_in
from uuvtai.compile.launch import TaichiLaunch, compiling, given
from uuvtai.config import Config
from uuvtai.kernels.planning import route
from uuvtai.kernels.planning.route import keep_route
from uuvtai.sim.behavior_tree import FlatTree
from uuvtai.sim.sim import Sim
from uuvtai.sim.stages import Stages
from uuvtai.vehicle.embedded import runtime
from uuvtai.vehicle.embedded.runtime import GOLDEN, MEMORY, SCHEMA, SPEC, decided, digest_of, packed_messages
from uuvtai.vehicle.onboard import Mission, OnboardPilot, SensorMessage, SimStack

# ---- One pilot's first steps: which kernels run in which order on which arguments, and LLVM's text of each.

Line = dict[str, Any]  # {"kernel": its number, "arguments": [..]} or {"do": what the host does}


@dataclass(frozen=True)
class RecordedKernel:
    """One kernel's text, and its tasks in their order."""

    name: str
    text: str
    tasks: list[str]


@dataclass
class Tape:
    """What was written down."""

    memory: np.ndarray  # all arrays before the first step, bytes
    arrays: dict[str, dict[str, Any]]  # where each lies in it, by 'struct.field'
    kernels: list[RecordedKernel] = field(default_factory=list)
    tensors: list[tuple[list[int], str]] = field(default_factory=list)
    """(shape, dtype) of arguments that are arrays; the first three: mask, seed and number of the episode"""
    begin: list[Line] = field(default_factory=list)  # the first step
    step: list[Line] = field(default_factory=list)  # every other one
    keep: list[Line] = field(default_factory=list)  # what is launched where a route could not be planned


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
        self._tape, self._sim = tape, sim
        self._known: dict[tuple[int, ...], tuple[int, TaichiLaunch]] = {}
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

    def serve(self, *_given: Any) -> int:
        """In place of the fallback planner."""
        self.note("route")
        return 0

    def launch(self, kernel: Any, arguments: tuple) -> None:
        """In place of a kernel: Taichi launches what it has compiled, and its text is kept."""
        key = (id(kernel), *map(id, arguments))
        if key not in self._known:
            self._known[key] = self._compiled(kernel, arguments)
            self._kept.append((kernel, arguments))  # an identity may be given again
        number, launch = self._known[key]
        self._lines.append({"kernel": number, "arguments": self._described(kernel, arguments)})
        launch.again()

    def _compiled(self, kernel: Any, arguments: tuple) -> tuple[int, TaichiLaunch]:
        with compiling(kernel, arguments):
            made = kernel.compiled_kernels[kernel.ensure_compiled(*arguments)]
            compiled, text = self.compiler.compiled(made)
        self._tape.kernels.append(RecordedKernel(kernel.func.__name__, text, tasks_in(text)))
        return len(self._tape.kernels) - 1, TaichiLaunch(kernel, arguments, (made, compiled))

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


# ---- From LLVM's text of the stack's kernels to a shared library for another machine: compiled by llvmlite,
# linked by LLD (package ziglang).

EXTRA = "uuvtai[aboard]"
_OF_A_PROCESSOR = re.compile(r'"(?:target-cpu|target-features|tune-cpu)"="[^"]*"')
_CONTEXT = re.compile(
    r"^define (?:dso_local )?void @[\w.]+_kernel_\d+\w*\((%struct\.RuntimeContext[\w.]*\*)", re.M
)

PARALLEL_FOR = """
; what kernels call for a parallel loop: one part after the other
define void @uuv_parallel_for(i8* %pool, i32 %count, i32 %wanted, i8* %context, void (i8*, i32, i32)* %body) {
entry:
  br label %next
next:
  %i = phi i32 [ 0, %entry ], [ %i.next, %do ]
  %more = icmp slt i32 %i, %count
  br i1 %more, label %do, label %done
do:
  call void %body(i8* %context, i32 0, i32 %i)
  %i.next = add i32 %i, 1
  br label %next
done:
  ret void
}
"""


class CrossError(UserError, RuntimeError):
    """What is missing to make a library for another machine."""


@dataclass(frozen=True)
class MachineKind:
    """A kind of computer, and what its code may use."""

    triple: str
    cpu: str
    features: str
    emulation: str  # LLD's word for it


KINDS = {
    "x86_64": MachineKind("x86_64-unknown-linux-gnu", "x86-64-v3", "", "elf_x86_64"),
    "aarch64": MachineKind("aarch64-unknown-linux-gnu", "cortex-a53", "", "aarch64linux"),
}
"""by ``platform.machine()``: PCs since 2013; a Raspberry Pi 3 or later"""


def function_name(number: int) -> str:
    """Of a kernel in the library."""
    return f"uuv_kernel_{number}"


def library_of(kernels: Sequence[RecordedKernel], kind: MachineKind) -> bytes:
    """Library with ``function_name(i)(arguments, runtime)`` a kernel, ``uuv_parallel_for``. CrossError."""
    objects = [_object(PARALLEL_FOR, kind, "uuv_parallel_for")]
    for number, kernel in enumerate(kernels):
        text = kernel.text + _entry(kernel, function_name(number))
        objects.append(_object(text, kind, function_name(number)))
    with tempfile.TemporaryDirectory(prefix="uuvtai-aboard-") as name:
        folder = Path(name)
        files = [folder / f"{number}.o" for number in range(len(objects))]
        for file, code in zip(files, objects, strict=True):
            file.write_bytes(code)
        out = folder / "stack.so"
        options = ["-m", kind.emulation, "-shared", "-z", "now", "--build-id=none", "-o", str(out)]
        command = [*linker(), "ld.lld", *options, *map(str, files)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode or not out.exists():
            raise CrossError(f"the linker refused ({done.stderr.strip()[:500]})")
        return out.read_bytes()


def linker() -> list[str]:
    """Beginning of its command. Raises CrossError."""
    if importlib.util.find_spec("ziglang") is None:
        raise CrossError(f"linking for another machine needs the package ziglang: pip install '{EXTRA}'")
    return [sys.executable, "-m", "ziglang"]


def _entry(kernel: RecordedKernel, name: str) -> str:
    """A function that runs the kernel's tasks one after the other."""
    found = _CONTEXT.search(kernel.text)
    assert found is not None
    own = "{ i8*, i8*, i32, i64* }"
    calls = [f"  call void @{task}({found[1]} %own)" for task in kernel.tasks]
    lines = [
        f"define void @{name}(i8* %arguments, i8* %runtime) {{",
        f"  %context = alloca {own}",
        "  %result = alloca [64 x i64]",
        *(f"  %at.{place} = getelementptr {own}, {own}* %context, i32 0, i32 {place}" for place in range(4)),
        "  %first = getelementptr [64 x i64], [64 x i64]* %result, i32 0, i32 0",
        "  store i8* %arguments, i8** %at.0",
        "  store i8* %runtime, i8** %at.1",
        "  store i32 0, i32* %at.2",
        "  store i64* %first, i64** %at.3",
        f"  %own = bitcast {own}* %context to {found[1]}",
        *calls,
        "  ret void",
        "}",
    ]
    return "\n" + "\n".join(lines) + "\n"


def _object(text: str, kind: MachineKind, public: str) -> bytes:
    """Machine code of a module in which nothing but ``public`` is seen from outside."""
    import llvmlite.binding as llvm

    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(kind.triple)
    machine = target.create_target_machine(
        cpu=kind.cpu, features=kind.features, opt=3, reloc="pic", codemodel="default"
    )
    module = llvm.parse_assembly(completed(_OF_A_PROCESSOR.sub("", text)))
    module.triple, module.data_layout = kind.triple, str(machine.target_data)
    for function in module.functions:
        if not function.is_declaration and function.name != public:
            function.linkage = "internal"
    module.verify()
    return emitted(module, machine)


PACKAGE = "uuv_stack"  # of the copied files
CHECKED_STEPS = 500
_ROOT = Path(__file__).parents[2]
_COPIED = (
    "vehicle/messages.py", "vehicle/onboard_core.py", "vehicle/sensor_inputs.py", "common/enums.py",
    "vehicle/embedded/runtime.py",
)  # fmt: skip
"""the frame around the kernels"""


class StackExportError(UserError, RuntimeError):
    """Why a stack cannot be exported."""


def export_stack(
    config: Config,
    tree: FlatTree,
    mission: Mission,
    arrivals: Sequence[tuple[int, SensorMessage]],
    out: Path,
    machines: Sequence[str],
) -> dict[str, Any]:
    """Write the folder; the document of ``uuv export LOG --json``. ``arrivals``: messages of a log, each
    with the step before which it arrives; what is decided on them goes into the folder as its check. Raises
    StackExportError, CrossError, OSError."""
    unknown = [name for name in machines if name not in KINDS]
    if unknown or not machines:
        raise StackExportError(f"--for {','.join(unknown)}: must be of {', '.join(KINDS)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StackExportError(f"{out}: is there already; give a new or an empty folder")
    linker()
    try:
        tape, sim = record(config, tree, mission)
        libraries = {name: library_of(tape.kernels, KINDS[name]) for name in machines}
    except UnfitError as error:
        raise StackExportError(f"Taichi's code cannot be exported here: {error}") from None
    steps = min(CHECKED_STEPS, arrivals[-1][0] + 1) if arrivals else 0
    shown = [arrival for arrival in arrivals if arrival[0] < steps]
    beside, kept = OnboardPilot(sim, mission), _KeptRoutes()
    sim.fallback = kept  # type: ignore[assignment]
    commands = decided(beside, shown, steps)
    with whole_folder(out) as new:
        _write(new, tape, beside, libraries)
        packed = {**packed_messages(shown), "commands": commands}
        (new / GOLDEN).write_bytes(_npz(packed))
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return {
        "schema": 1,
        "folder": str(out),
        "machines": list(machines),
        "kernels": len(tape.kernels),
        "checked_steps": steps,
        "kept_routes": kept.count,
        "bytes": size,
    }


class _KeptRoutes:
    """In place of the second planner, which the folder does not have: the old route stays."""

    count = 0

    def serve(self, stages: Stages, _seed_of: Any, _read: Any, count: Callable[[Any], int], *_: Any) -> int:
        if failed := count(stages.route.route.n_failed):
            keep_route(stages.route, 0)
            self.count += 1
        return failed


def _write(folder: Path, tape: Tape, pilot: OnboardPilot, code: dict[str, bytes]) -> None:
    """All but the check."""
    package = folder / PACKAGE
    package.mkdir(parents=True)
    for name in _COPIED:
        text = (_ROOT / name).read_text(encoding="utf-8")
        for folder_name in ("uuvtai.vehicle.embedded.", "uuvtai.vehicle.", "uuvtai.common."):
            text = text.replace(f"from {folder_name}", f"from {PACKAGE}.")
        (package / Path(name).name).write_text(text, encoding="utf-8")
    (package / "__init__.py").write_text('"""The stack of uuvtai without Taichi and torch."""\n')
    main = f"from {PACKAGE}.{Path(runtime.__file__).stem} import main\n\nraise SystemExit(main())\n"
    (package / "__main__.py").write_text(main)
    libraries = {machine: f"{machine}.so" for machine in code}
    for machine, library in code.items():
        (folder / libraries[machine]).write_bytes(library)
    (folder / MEMORY).write_bytes(_npz({"memory": tape.memory}))
    spec = {
        "schema": SCHEMA,
        "uuvtai": __version__,
        "libraries": libraries,
        "sha256": {name: digest_of(folder / name) for name in (*libraries.values(), MEMORY)},
        "runtime": runtime_layout(),
        "numbers": dataclasses.asdict(pilot.numbers),
        "mission": dataclasses.asdict(pilot.mission),
        "kernels": [kernel.name for kernel in tape.kernels],
        **{name: getattr(tape, name) for name in ("tensors", "begin", "step", "keep", "arrays")},
        "config": pilot.config.model_dump(mode="json"),
    }
    (folder / SPEC).write_text(json.dumps(spec), encoding="utf-8")
    (folder / "README.md").write_text(_README, encoding="utf-8")


def _npz(arrays: dict[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


_README = f"""# A stack of uuvtai {__version__}
Needs Python 3.10 and NumPy, on Linux. From this folder:

```sh
python3 -m {PACKAGE}
```

decides anew on the messages of `{GOLDEN}` and compares (exit code 3: it decides something else).

```python
from pathlib import Path
from {PACKAGE}.{Path(runtime.__file__).stem} import carried_pilot
from {PACKAGE}.messages import ImuReading, Mission

pilot = carried_pilot(Path("."), Mission(start=(2, 3, -0.8), goal=(18, 3, -0.8)))
pilot.feed(ImuReading(0.0, rpy, rate_b, specific_force_b))  # whenever a message comes
command = pilot.tick()  # every 20 ms: command.velocity, command.leaf, command.held
```

World, sensors and tree are those of the log that it was exported with. Where no route is found the old one
stays: the second planner (RRT) is not here. It was never in the water.
"""
