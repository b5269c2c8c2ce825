"""From LLVM's text of the stack's kernels to a shared library for another machine: compiled by llvmlite,
linked by LLD (package ziglang)."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from uuvtai.aboard.tape import RecordedKernel
from uuvtai.errors import UserError

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
    emulation: str
    """LLD's word for it"""


KINDS = {
    "x86_64": MachineKind("x86_64-unknown-linux-gnu", "x86-64-v3", "", "elf_x86_64"),
    "aarch64": MachineKind("aarch64-unknown-linux-gnu", "cortex-a53", "", "aarch64linux"),
}
"""by ``platform.machine()``: PCs since 2013; a Raspberry Pi 3 or later"""


def function_name(number: int) -> str:
    """Of a kernel in the library."""
    return f"uuv_kernel_{number}"


def library_of(kernels: Sequence[RecordedKernel], kind: MachineKind) -> bytes:
    """A shared library with a function ``function_name(i)(arguments, runtime)`` for each kernel, and
    ``uuv_parallel_for``. Raises CrossError."""
    words = linker()
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
        words = [
            *words,
            "ld.lld",
            "-m",
            kind.emulation,
            "-shared",
            "-z",
            "now",
            "--build-id=none",
            "-o",
            str(out),
        ]
        done = subprocess.run([*words, *map(str, files)], capture_output=True, text=True, check=False)
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
    module = llvm.parse_assembly(_OF_A_PROCESSOR.sub("", text))
    module.triple, module.data_layout = kind.triple, str(machine.target_data)
    for function in module.functions:
        if not function.is_declaration and function.name != public:
            function.linkage = "internal"
    module.verify()
    return machine.emit_object(module)
