"""Machine code of the kernels' own: compared with Taichi's, kept safely, refused where it does not fit."""

import ast
import dataclasses
import errno
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from inspect import getsourcelines
from pathlib import Path

import numpy as np
import pytest
import taichi as ti
import torch

import uuvtai
from uuvtai.compile import cache, codegen
from uuvtai.compile.codegen import RUNTIME_TYPE, Native, UnfitError, tasks_in
from uuvtai.compile.launch import VARIABLE, is_gpu_shaped, native, quick_launch
from uuvtai.compile.memory import Memory, address_of
from uuvtai.config import EpisodeConfig
from uuvtai.kernels.core.stage import Bundle, Const, FloatMatrix, FloatVector, In, Out
from uuvtai.state.arrays import allocate, array

ROOT = Path(__file__).resolve().parents[2]

KEPT = [".kernel", ".kernel"]
"""of one kernel: its code, and what of its bundle it depends on"""
N = 3000
"""more items than one block of a loop has, so that threads share them"""


@dataclasses.dataclass
class Sums:
    """A struct as those of ``state``."""

    total: ti.Field = array("n_env")
    pair: ti.Field = array("n_env", vec=2)
    rest: ti.Field = array("n_env", scratch=True)


@dataclasses.dataclass
class Source:
    value: ti.Field = array("n_env")


@dataclasses.dataclass(frozen=True, eq=False)
class SumsIO:
    """Like a stage's bundle."""

    sums: "Out[Sums]"
    source: "In[Source]"
    rules: "Const[EpisodeConfig]"


@quick_launch
@ti.kernel
def add_up(io: Bundle[SumsIO], table: FloatMatrix, weight: float, count: int, out: FloatVector):
    """Numbers, tensors of two ranks, fields and a config section."""
    for i in range(N):
        io.sums.total[i] += weight * io.source.value[i] + count + table[i % 2, 1] + io.rules.control_dt_s
        io.sums.pair[i] = ti.Vector([io.sums.total[i], ti.sin(io.source.value[i])])
        io.sums.rest[i] = 1.0
    for i in range(count * 1000):
        out[i] = io.sums.total[i] + io.sums.pair[i][1]


@dataclasses.dataclass
class Unread:
    """What no kernel asks for."""

    other: ti.Field = array("n_unread")


@dataclasses.dataclass(frozen=True, eq=False)
class LargerIO(SumsIO):
    unread: "In[Unread]"


@dataclasses.dataclass
class Structs:
    sums: Sums
    source: Source
    unread: Unread


class Scene:
    """Arrays, in this order and with so many that nobody reads; a bundle over them, and tensors."""

    def __init__(self, order=(Sums, Source, Unread), n_unread=4):
        sizes = {"n_env": N, "n_unread": n_unread}
        built = {kind: allocate(kind, sizes) for kind in order}
        self.structs = Structs(*(built[kind] for kind in (Sums, Source, Unread)))
        self.io = LargerIO(
            self.structs.sums, self.structs.source, EpisodeConfig(), unread=self.structs.unread
        )
        anchor = self.structs.sums.total
        anchor.fill(0.0)
        self.structs.source.value.from_numpy(np.linspace(0, 3, N, dtype=np.float32))
        self.memory = Memory(
            self.structs, anchor, address_of(anchor, torch.device("cpu")), torch.device("cpu")
        )
        self.table = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
        self.out = torch.zeros(N)

    def launch(self):
        """Once; total and out."""
        add_up(self.io, self.table, 0.5, 3, self.out)
        return self.structs.sums.total.to_numpy(), self.out.numpy().copy()


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty folder for machine code, and no ``Native`` yet."""
    monkeypatch.setenv("UUV_NATIVE_CACHE", str(tmp_path / "native"))
    kept = native[:]
    native.clear()
    yield tmp_path / "native"
    native[:] = kept


def started(scene, place):
    """A new process's ``Native``, as far as the store can tell."""
    native[:] = [Native()]
    native[0].adopt([scene.io], scene.memory)
    return native[0]


@pytest.fixture(scope="module")
def expected():
    """What Taichi says after one, two, three and four launches."""
    scene = Scene()
    return [scene.launch() for _ in range(4)]


@pytest.mark.parametrize("threads", ["1", "2", "5"])
def test_it_is_made_once_found_again_and_does_what_taichi_does(place, expected, monkeypatch, threads):
    monkeypatch.setenv("UUV_NUM_THREADS", threads)
    first = Scene()
    ours = started(first, place)
    for total, out in expected[:3]:
        np.testing.assert_array_equal(first.launch(), (total, out))
    assert (ours.found, ours.made, ours.refused) == (0, 1, 0)
    assert [p.suffix for p in place.iterdir()] == KEPT
    assert place.stat().st_mode & 0o777 == 0o700
    ours.compiler.compiled = None  # type: ignore[assignment]  # what is found is not compiled
    ours.adopt([moved := dataclasses.replace(first.io)], first.memory)  # another bundle, the same arrays
    add_up(moved, first.table, 0.5, 3, first.out)
    np.testing.assert_array_equal((first.structs.sums.total.to_numpy(), first.out), expected[3])
    elsewhere = Scene()  # arrays in the same order in another tree of fields
    ours.adopt([elsewhere.io], elsewhere.memory)
    np.testing.assert_array_equal(elsewhere.launch(), expected[0])
    assert (ours.found, ours.made, ours.refused) == (2, 1, 0)


def test_tensors_may_move_and_grow(place):
    scene = Scene()
    started(scene, place)
    scene.launch()
    scene.out.set_(torch.zeros(N + 512))  # type: ignore[call-overload]
    total, out = scene.launch()
    np.testing.assert_array_equal(out[:N] != 0, True)
    np.testing.assert_array_equal(out[N:], 0)
    assert total[0] == pytest.approx(2 * (3 + 2 + EpisodeConfig().control_dt_s))


def test_code_that_does_something_else_is_never_used(place, expected, monkeypatch):
    """One constant of the compiled kernel is another; the first launch sees it, Taichi's result stands."""
    scene = Scene()
    ours = started(scene, place)
    real = ours.machine.object_of
    monkeypatch.setattr(ours.machine, "object_of", lambda text: real(changed(text)))
    with pytest.warns(
        RuntimeWarning, match="add_up: its own machine code gives another result; Taichi launches it"
    ):
        np.testing.assert_array_equal(scene.launch(), expected[0])
    np.testing.assert_array_equal(scene.launch(), expected[1])
    assert (ours.made, ours.refused, list(place.glob("*.kernel"))) == (0, 1, [])


@pytest.mark.skipif(platform.machine() != "x86_64", reason="looks for x86's instructions")
def test_fetching_waits_for_nothing(place):
    text = "define void @f(i16* %p) {\n%1 = atomicrmw or i16* %p, i16 0 seq_cst\nret void\n}"
    code = started(Scene(), place).machine.object_of(text)
    assert b"\x0f\x0d" in code or b"\x0f\x18" in code, "a prefetch in place of a locked instruction"


def test_a_loop_whose_end_is_not_known_has_blocks_of_any_size(place):
    """As Taichi compiles it they have 512 items; what threads make of it, the tests above ask."""
    scene, texts = Scene(), []
    machine = started(scene, place).machine
    emit = machine.object_of
    machine.object_of = lambda text: texts.append(text) or emit(text)
    scene.launch()
    assert [len(codegen._BLOCK.findall(text)) for text in texts] == [1]


def test_where_a_tree_begins_is_asked_once(place):
    ask = """
  %a{0} = load %struct.LLVMRuntime*, %struct.LLVMRuntime** %at, align 8
  %b{0} = getelementptr inbounds %struct.LLVMRuntime, %struct.LLVMRuntime* %a{0}, i64 0, i32 7, i64 1
  %c{0} = load i8*, i8** %b{0}, align 8
  store i8 {0}, i8* %c{0}"""
    text = "%struct.LLVMRuntime = type { i8*, i8*, i8*, i8*, i8*, i8*, i8*, [2 x i8*] }\ndefine void @f"
    text += "(%struct.LLVMRuntime** %at) {\n" + "".join(map(ask.format, range(9))) + "\nret void\n}"
    asked_once, asked_again = map(started(Scene(), place).machine.object_of, (text, text.replace("LLVM", "")))
    assert len(asked_once) + 8 * 6 < len(asked_again)


def changed(text):
    """LLVM's text with its first addition of floats turned into a subtraction."""
    assert " fadd " in text
    return text.replace(" fadd ", " fsub ", 1)


FAR_APART = """
import ctypes, mmap
from uuvtai.compile.codegen import Machine

libc = ctypes.CDLL(None)
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
libc.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
PRIVATE, FIXED, WALL = 0x4022, 0x100000, 5 << 30


def reserved(size, at=None):
    return libc.mmap(at, size, 0, PRIVATE | (FIXED if at else 0), -1, 0)


machine = Machine(1)
code = machine.object_of('''
@table = private unnamed_addr constant [3 x float] [float 1.5, float 2.5, float 3.5]
define void @kernel(float* %at, i32 %i) {
  %place = getelementptr [3 x float], [3 x float]* @table, i32 0, i32 %i
  %value = load float, float* %place
  store float %value, float* %at
  ret void
}
''')
lowest = reserved(mmap.PAGESIZE)
for power in range(30, 11, -1):  # no gap is left above
    while (place := reserved(1 << power)) > lowest:
        pass
    lowest = place
for pages in (1, 2, 3):  # but this one, and the next is 5 GiB away
    gap = reserved((pages + 2) * mmap.PAGESIZE)
    assert reserved(WALL, gap - WALL) == gap - WALL
    libc.munmap(gap + mmap.PAGESIZE, pages * mmap.PAGESIZE)
    (kernel,) = machine.tasks_of(code, ["kernel"])
    out = ctypes.c_float()
    ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int32)(kernel)(ctypes.addressof(out), 2)
    print(out.value)
"""


def test_another_runtime_is_refused():
    with pytest.raises(UnfitError, match="another layout"):
        tasks_in("%struct.LLVMRuntime.6 = type { i8*, i32 }\n")
    with pytest.raises(UnfitError, match="told apart"):
        tasks_in(f"%struct.LLVMRuntime.6 = type {RUNTIME_TYPE}i8* }}\n")


def test_adopt_says_in_one_line_why_not(place, monkeypatch):
    place.mkdir(mode=0o700)
    place.chmod(0o777)
    scene = Scene()
    with pytest.warns(RuntimeWarning, match=r"others could have written it.*; Taichi launches all kernels"):
        codegen.adopt([scene.io], scene.memory)
    assert not native
    place.chmod(0o700)
    monkeypatch.setattr(codegen.ti, "__version__", (1, 8, 0))
    with pytest.warns(RuntimeWarning, match=r"Taichi 1\.8\.0 is not 1\.7\.4"):
        codegen.adopt([scene.io], scene.memory)
    assert not native


# ------------------------------------------------------------------------------------------------ processes

_PROCESS = """
import hashlib, os, signal, sys
from tests.compile.test_native import FAR_APART, Scene
from uuvtai.compile import cache, codegen
from uuvtai.compile.runtime import start_taichi
from uuvtai.config.loader import load_config
from uuvtai.sim.setup import check_size


def launch():
    start_taichi("cpu")
    scene = Scene()
    codegen.adopt([scene.io], scene.memory)
    for _ in range(2):
        total, out = scene.launch()
    found = codegen.native[0]
    told = f"{found.made} {found.found} {hashlib.sha256(total.tobytes() + out.tobytes()).hexdigest()}\\n"
    os.write(1, told.encode())


def killed():
    cache.os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
    launch()


def walls():
    exec(FAR_APART, {})
    sys.stdout.flush()


def size():
    check_size(load_config(), 8, "cpu")


for line in sys.stdin:
    children = []
    do, crowd, os.environ["UUV_NATIVE_CACHE"] = line.split()
    while len(children) < int(crowd):
        children.append(os.fork())  # before Taichi starts, whose threads a child would lack
        if not children[-1]:
            globals()[do]()
            os._exit(0)
    print("ended", *[os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children], flush=True)
"""


@pytest.fixture(scope="module")
def forks():
    """``forks(do, crowd, place)``: as many processes at once that do so, with machine code in ``place``; what
    they say, and how they ended. What they import is imported once."""
    environment = {**os.environ, "UUV_NUM_THREADS": "1"}
    command, pipe = [sys.executable, "-c", _PROCESS], subprocess.PIPE
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdin=pipe, stdout=pipe, text=True) as process:

        def ask(do, crowd=1, place="nowhere"):
            process.stdin.write(f"{do} {crowd} {place}\n")
            process.stdin.flush()
            lines = []
            while not lines or lines[-1][0] != "ended":
                lines += [words for words in [process.stdout.readline().split()] if words[0] != "[Taichi]"]
            return lines[:-1], [int(code) for code in lines[-1][1:]]

        yield ask
        process.stdin.close()


@pytest.mark.skipif(sys.platform != "linux", reason="own machine code is for Linux")
def test_code_finds_its_constants_in_a_process_whose_memory_is_full_of_walls(forks):
    """With 5 GiB between two gaps: a distance of 32 bits does not reach across."""
    assert forks("walls") == ([["3.5"]] * 3, [0])


def test_sizes_are_known_before_taichi_has_started(forks):
    """``uuv profile`` asks whether all sizes fit before it makes the first simulator."""
    assert forks("size") == ([], [0])


def test_processes_at_once_leave_one_whole_file_also_where_one_was_killed_while_it_wrote(forks, place):
    assert forks("killed", 1, place) == ([], [-signal.SIGKILL])
    (part,) = place.iterdir()
    assert part.suffix == ".tmp"
    results, codes = forks("launch", 2, place)
    assert len(results) == 2 and codes == [0, 0]
    assert all(int(made) + int(found) == 1 for made, found, _ in results)
    assert any(made == "1" for made, *_ in results) and len({digest for *_, digest in results}) == 1
    os.utime(part, (0, 0))
    cache.Store(place).bound()
    assert [path.suffix for path in place.iterdir()] == KEPT, "an old unfinished file goes"
    assert forks("launch", 1, place) == ([["0", "1", results[0][2]]], [0])


def test_folders_of_killed_processes_are_deleted(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    alive = codegen.Compiler()
    (killed := tmp_path / "uuvtai-native-killed").mkdir()
    (killed / "lock").touch()
    (killed / "0.ll").touch()
    (tmp_path / "uuvtai-native-new").mkdir()
    (tmp_path / "uuvtai-native-link").symlink_to(tmp_path)
    codegen.Compiler().close()
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {alive._folder.name, "uuvtai-native-new", "uuvtai-native-link"}
    alive.close()


def test_where_nothing_can_be_kept_taichi_launches(tmp_path, place, expected, monkeypatch):
    """A home that cannot be written to: here a file stands in the way, for root may write anywhere."""
    (tmp_path / "home").write_text("")
    monkeypatch.setenv("UUV_NATIVE_CACHE", str(tmp_path / "home" / "native"))
    scene = Scene()
    with pytest.warns(RuntimeWarning, match=r"Not a directory; Taichi launches all kernels"):
        codegen.adopt([scene.io], scene.memory)
    np.testing.assert_array_equal(scene.launch(), expected[0])


# ------------------------------------------------------------------------------------------------- keys


BESIDE = ("errors", "files", "presets", "version")
"""what no kernel's code depends on"""


def test_every_source_that_kernels_import_is_part_of_the_key():
    root = Path(uuvtai.__file__).parent
    seen = {name.removesuffix(".py") for name in cache._SEEN_BY_KERNELS}
    files = [
        p
        for name in cache._SEEN_BY_KERNELS
        for p in ([root / name] if name.endswith(".py") else (root / name).rglob("*.py"))
    ]
    assert len(files) > 80
    for path in files:
        for node in ast.walk(ast.parse(path.read_text())):
            for module in names_of(node):
                if module.startswith("uuvtai."):
                    named = "/".join(module.split(".")[1 : 3 if module.startswith("uuvtai.common") else 2])
                    assert named in seen | {f"common/{name}" for name in BESIDE}, (path, module)


def test_the_text_in_the_key_is_the_text_that_is_compiled(tmp_path, monkeypatch):
    """Whenever a source changes: before it is read for the key, or before Taichi reads it, and back again."""
    source = tmp_path / "kernels.py"
    source.write_text("def kernel():\n    return 1\n")
    space = {}
    exec(compile(source.read_text(), str(source), "exec"), space)
    monkeypatch.setattr(cache, "_ROOT", tmp_path)
    monkeypatch.setattr(cache, "_SEEN_BY_KERNELS", ("kernels.py",))
    digest = cache.digest_of_sources.__wrapped__
    with pytest.raises(cache.StoreError, match=r"kernels\.py: has changed since this process began"):
        digest()
    monkeypatch.setattr(cache, "BEGUN_NS", time.time_ns() + 10**9)
    before = digest()
    source.write_text("def kernel():\n    return 77\n")
    assert "77" not in "".join(getsourcelines(space["kernel"])[0]) and digest() != before


def names_of(node):
    """Modules that a statement imports."""
    if isinstance(node, ast.ImportFrom) and node.module == "uuvtai.common":
        return [f"{node.module}.{alias.name}" for alias in node.names]
    if isinstance(node, ast.ImportFrom) and node.module:
        return [node.module]
    return [alias.name for alias in node.names] if isinstance(node, ast.Import) else []


def test_arrays_that_a_kernel_does_not_read_compile_nothing(place, expected):
    first = Scene()
    ours = started(first, place)
    first.launch()
    for order, n_unread, made in (
        ((Sums, Source, Unread), 500, 1), ((Sums, Source, Unread), N, 1), ((Unread, Sums, Source), 500, 2),
        ((Source, Sums, Unread), 4, 3),
    ):  # fmt: skip
        other = Scene(order, n_unread)
        ours.adopt([other.io], other.memory)
        np.testing.assert_array_equal(other.launch(), expected[0])
        assert (ours.made, ours.refused) == (made, 0)


def test_what_is_read_of_arrays_is_noted():
    io = Scene().io
    assert [(place, type(struct)) for place, struct in cache.structs_in(io)] == [
        ("sums", Sums), ("source", Source), ("unread", Unread),
    ]  # fmt: skip
    with cache.noted(io) as (names, _):
        assert io.source.value.shape == (N,) and not hasattr(io.unread, "nothing")
    assert names == {"@source.value"}
    with cache.noted(io) as (names, _):
        assert len(vars(io.sums)) == 3
    assert names == {"@sums.total", "@sums.pair", "@sums.rest"}
    with cache.noted(io) as (names, _):
        pass
    assert io.unread.other.shape == (4,) and names == set(), "nothing is noted any more"


def test_a_key_tells_configs_places_and_kinds_apart(monkeypatch):
    first, second = Scene(), Scene()
    tree = first.memory.tree
    told = {cache.described(value, tree) for value in (first.io, first.table, first.out, first.out.double())}
    assert len(told) == 4 and len(cache.digest_of_sources()) == 64
    assert cache.described(first.io, tree) == cache.described(second.io, second.memory.tree), (
        "the same places in another tree"
    )
    with pytest.raises(cache.KeyNameError, match="a field of tree"):
        cache.described(second.io, tree)
    with pytest.raises(cache.KeyNameError):
        cache.described(object(), tree)
    assert cache.described(first.io) == cache.described(Scene((Source, Sums, Unread)).io), "without places"
    other = dataclasses.replace(first.io, rules=EpisodeConfig(control_dt_s=0.05))
    of_time, of_horizon = (
        [cache.key_with("k", [name], io, tree) for io in (first.io, other)]
        for name in ("rules.control_dt_s", "rules.horizon_steps")
    )
    assert of_time[0] != of_time[1] and of_horizon[0] == of_horizon[1] != of_time[0], (
        "what a kernel does not read is not in its key"
    )
    with cache.noted(first.io) as (names, _):
        assert not is_gpu_shaped()
    plain = cache.key_with("k", names, first.io, tree)
    assert Native().surroundings[-1].split()[-1] == "f32", "what numbers are that no array tells"
    monkeypatch.setenv(VARIABLE, "gpu")
    assert cache.key_with("k", names, first.io, tree) != plain, "it asks for the shape"
    assert cache.key_with("k", ["rules.control_dt_s"], first.io, tree) == of_time[0], "it does not"


# ------------------------------------------------------------------------------------------------ store


@pytest.fixture
def store(tmp_path):
    return cache.Store(tmp_path / "deep" / "native")


K = [f"{number:064x}" for number in range(6)]
CODE = cache.MachineCode(["a_kernel_0_serial"], b"\x7fELF" + bytes(range(256)) * 40)


def test_what_is_put_is_got_and_nothing_else(store):
    assert store.get("k1") is None
    store.put("k1", CODE)
    assert store.get("k1") == CODE
    store.put("k1", cache.MachineCode([], b"new"))
    assert store.get("k1") == cache.MachineCode([], b"new")
    assert [p.name for p in store.folder.iterdir()] == ["k1.kernel"]


@pytest.mark.parametrize("at", [0, 5, 20, 90, 200, -1])
@pytest.mark.parametrize("kind", ["flip", "cut"])
def test_damage_is_as_good_as_missing(store, at, kind):
    store.put("k", CODE)
    path = store.folder / "k.kernel"
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content if kind == "flip" else content[:at])
    assert store.get("k") is None


def test_a_file_under_another_name_is_not_run(store):
    store.put("k", CODE)
    os.rename(store.folder / "k.kernel", store.folder / "other.kernel")
    assert store.get("other") is None


def test_foreign_files_and_folders_are_refused(store, tmp_path):
    store.put("k", CODE)
    path = store.folder / "k.kernel"
    path.chmod(0o666)
    with pytest.raises(cache.StoreError, match="others could have written it"):
        store.get("k")
    path.chmod(0o600)
    (store.folder / "link.kernel").symlink_to(path)
    with pytest.raises(cache.StoreError):
        store.get("link")
    (tmp_path / "file").write_text("")
    with pytest.raises(cache.StoreError):
        cache.Store(tmp_path / "file")
    (tmp_path / "way").symlink_to(store.folder)
    with pytest.raises(cache.StoreError, match="link"):
        cache.Store(tmp_path / "way")


def test_a_full_disk_leaves_nothing_half(store, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(cache.StoreError, match="No space left"):
        store.put("k", CODE)
    assert list(store.folder.iterdir()) == []


def test_the_folder_is_bounded_and_what_is_used_stays(store):
    theirs = ("notes.txt", "k.kernel", f"{K[0]}.kernel.bak", "tmp.part", "a.mcap.0a1b2c3d.part")
    for name in theirs:
        (store.folder / name).write_text("precious")
        os.utime(store.folder / name, (0, 0))
    for number in range(6):
        store.put(K[number], CODE)
        os.utime(store.folder / f"{K[number]}.kernel", (number, number))
    assert store.get(K[0]) == CODE  # used: newest now
    assert store.bound(3 * (store.folder / f"{K[0]}.kernel").stat().st_size) == 3
    assert [p.stem for p in sorted(store.files())] == [K[0], K[4], K[5]]
    assert store.clear() == 3 and sorted(p.name for p in store.folder.iterdir()) == sorted(theirs)
