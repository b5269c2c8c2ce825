"""The house stays as drawn: who may import whom, who may see the truth, what a kernel file may contain."""

import ast
import dataclasses
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import taichi as ti

from tests import signatures
from tests.signatures import BUNDLES, FILES, KERNELS, ROOMS, functions, is_kernel
from tests.sources import nodes_of
from uuvtai import config, state
from uuvtai.common.enums import Truth
from uuvtai.sim.stages import members_of

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "uuvtai"

KNOWS = {"world", "vehicle", "sensors", "task", "oracle"}
"""Rooms that may see the truth; the others are the stack."""
BELOW = ("common", "state", "config", "compile", "kernels")
"""What kernels may import of the package."""
STACK = {"core", "perception", "planning", "behavior", "baselines"}
TRUTH = {
    kind.__name__
    for module in (state, config)
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Truth)
}


def room_of(path):
    return path.parent.name


def names_in(path):
    """Every identifier and attribute that a file mentions in code."""
    nodes = nodes_of(path)
    return (
        {n.id for n in nodes if isinstance(n, ast.Name)}
        | {a.name for n in nodes if isinstance(n, ast.ImportFrom) for a in n.names}
        | {n.attr for n in nodes if isinstance(n, ast.Attribute)}
    )


def imports_of(path):
    found = set()
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def test_no_import_contract_has_an_exemption():
    text = (ROOT / "pyproject.toml").read_text()
    assert text.count("[[tool.importlinter.contracts]]") > 3
    assert "ignore_imports" not in text


def test_there_is_something_to_check():
    assert {"WorldState", "VehicleState", "PathState", "EpisodeState", "WorldConfig"} <= TRUTH
    assert set(ROOMS) == KNOWS | STACK
    assert len(BUNDLES) > 20 and len(functions()) > 450
    assert {kind for bundle in BUNDLES.values() for kind in members_of(bundle).values()} >= TRUTH, (
        "some truth is nobody's"
    )


@pytest.mark.parametrize(
    "path", [p for p in KERNELS.rglob("*.py") if room_of(p) in STACK], ids=lambda p: f"{room_of(p)}.{p.stem}"
)
def test_the_stack_never_names_the_truth(path):
    """Nor is it handed any: a bundle is a file of its room, imports come from the stack's rooms."""
    assert not names_in(path) & TRUTH
    for module in imports_of(path):
        parts = module.split(".")
        if parts[:2] == ["uuvtai", "kernels"] and len(parts) > 2:
            assert parts[2] in STACK, f"{path.name} imports {module}"


def test_what_knows_the_truth_writes_nothing_that_the_stack_reads_but_readings():
    """Instruments, clock and mission are what the vehicle may know."""
    known = {
        kind
        for name in BUNDLES
        if name in ("EpisodeIO", "WorldIO")
        for kind in ("ClockState", "MissionState")
    }
    readings = {"Proprioception", "SonarScan", "DepthImage"}
    of_the_stack = {
        kind
        for name, bundle in BUNDLES.items()
        if room_of_bundle(name) in STACK
        for kind in members_of(bundle).values()
    }
    assert readings | known <= of_the_stack
    for name, bundle in BUNDLES.items():
        outputs = {
            members_of(bundle)[f.name] for f in dataclasses.fields(bundle) if str(f.type).startswith("Out")
        }
        if set(members_of(bundle).values()) & TRUTH and room_of_bundle(name) != "oracle":
            assert outputs & of_the_stack <= readings | known, f"{name} writes {outputs & of_the_stack}"


def room_of_bundle(name):
    return BUNDLES[name].__module__.split(".")[2]


@pytest.mark.parametrize("path", FILES, ids=lambda p: f"{room_of(p)}.{p.stem}")
def test_kernels_import_taichi_and_the_floor_only(path):
    assert "import uuvtai\n" not in path.read_text(), f"{path.name} imports the whole package"
    foreign = {i.split(".")[0] for i in imports_of(path)} - {"uuvtai", "taichi", "typing", "math"}
    assert not foreign, f"{path.name} imports {foreign}"
    for module in (i for i in imports_of(path) if i.startswith("uuvtai.")):
        parts = module.split(".")
        assert parts[1] in BELOW, f"{path.name} imports {module}"
        if room_of(path) == "core" and parts[1] == "kernels":
            assert parts[2] == "core", f"{path.name} imports {module}"


def test_kernel_files_lend_functions_never_kernels():
    """A kernel is launched by the simulator, in its order; what two files share is a function."""
    kernels = {
        f"{module}.{name}" for (module, name), function in functions().items() if is_kernel(function.node)
    }
    assert len(kernels) > 30
    for path in FILES:
        assert not imports_of(path) & kernels, f"{path.name} imports {imports_of(path) & kernels}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: f"{room_of(p)}.{p.stem}")
def test_kernel_files_stay_in_the_safe_subset(path):
    text = path.read_text()
    assert "from __future__ import annotations" not in text, "Taichi needs real annotations"
    for call in (n for n in nodes_of(path) if isinstance(n, ast.Call)):
        name = ast.unparse(call.func)
        assert name not in ("ti.random", "ti.randn", "ti.init", "print"), (
            f"{path.name}:{call.lineno} calls {name}"
        )


def wrongs_of(function):
    """Where a function writes what it only reads, or hands it to one that writes it."""
    marks = function.marks()
    for root, line in signatures.written(function):
        if marks.get(root, ("Out", ""))[0] != "Out":
            yield f"{function.path.name}:{line} {function.name} writes {root}"
    for root, mark, kind, called, line in signatures.handed(function):
        if mark == "Bundle" and root != "io":
            yield f"{function.path.name}:{line} {function.name} hands {root} to {called} as {kind}"
        if mark == "Out" and marks.get(root, ("Out", ""))[0] != "Out":
            yield f"{function.path.name}:{line} {function.name} hands {root} to {called}, which writes it"


def test_no_function_writes_what_it_only_reads():
    assert not [wrong for function in functions().values() for wrong in wrongs_of(function)]


@pytest.mark.parametrize(
    ("body", "wrong"),
    [
        ("io.route.arc[env] = 1.0", None),
        ("io.clock.step[env] += 1", "writes io.clock"),
        ("a, io.ego.pos_w[env] = 1, 2", "writes io.ego"),
        ("ti.atomic_add(io.mission.goal_w[env], 1)", "writes io.mission"),
        ("clear_track(env, 0, io.clock)", "hands io.clock to clear_track"),
    ],
)
def test_a_wrong_write_would_be_found(body, wrong):
    source = f"def made_up(env, io: Bundle[RouteIO]):\n    {body}\n"
    calls = {name: (module, name) for module, name in functions() if name == "clear_track"}
    found = list(wrongs_of(signatures.Function(Path("made_up.py"), ast.parse(source).body[0], calls)))
    assert (wrong is None and found == []) or (len(found) == 1 and wrong in found[0])


def test_every_kernel_says_what_it_takes_and_nothing_is_handed_over_in_vain():
    for function in functions().values():
        names = [argument.arg for argument in function.node.args.args]
        if is_kernel(function.node):
            assert ast.get_docstring(function.node), f"{function.name} has no docstring"
            assert all(argument.annotation is not None for argument in function.node.args.args), function.name
        used = {node.id for node in ast.walk(function.node) if isinstance(node, ast.Name)}
        assert set(names) <= used | {"io"}, (
            f"{function.path.name}: {function.name} does not use {set(names) - used}"
        )


def test_every_bundle_holds_what_its_stage_touches_and_nothing_else():
    """Members that some function of the stage names; what is marked Out is written by one."""
    touched, stored = {name: set() for name in BUNDLES}, {name: set() for name in BUNDLES}
    for function in functions().values():
        bundle = next(
            (
                kind
                for a in function.node.args.args
                for mark, kind in [signatures.mark_of(a)]
                if mark == "Bundle"
            ),
            None,
        )
        if bundle is None:
            continue
        for node in ast.walk(function.node):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "io":
                touched[bundle].add(node.attr)
        stored[bundle] |= {root[3:] for root, _ in signatures.written(function) if root.startswith("io.")}
        stored[bundle] |= {
            root[3:]
            for root, mark, *_ in signatures.handed(function)
            if mark == "Out" and root.startswith("io.")
        }
    for name, bundle in BUNDLES.items():
        members = {f.name: str(f.type).partition("[")[0] for f in dataclasses.fields(bundle)}
        assert touched[name] == set(members), f"{name}: {touched[name] ^ set(members)}"
        assert stored[name] == {member for member, mark in members.items() if mark == "Out"}, (
            f"{name}: {stored[name]}"
        )


def test_only_one_room_knows_taichis_inside_and_only_the_runtime_starts_it():
    for path in PACKAGE.rglob("*.py"):
        taken = [str(n.module) for n in nodes_of(path) if isinstance(n, ast.ImportFrom)]
        taken += [name.name for n in nodes_of(path) if isinstance(n, ast.Import) for name in n.names]
        assert path.parent == PACKAGE / "compile" or not any(name.startswith("taichi.") for name in taken)
        calls = [ast.unparse(n.func) for n in nodes_of(path) if isinstance(n, ast.Call)]
        assert ("ti.init" in calls) == (path == PACKAGE / "compile/runtime.py")


LAUNCHERS = (
    "sim/sim", "sim/stack", "sim/plant", "sim/rrt", "vehicle/onboard", "vehicle/sitl",
    "vehicle/embedded/export",
)  # fmt: skip
"""files that run stages: of thousands of vehicles, of one on board, of one without a world, of ArduSub's, of
one that is written down"""


def test_only_those_who_run_stages_launch_kernels():
    stages = {signatures.module_of(path) for path in FILES if "@ti.kernel" in path.read_text()}
    for path in PACKAGE.rglob("*.py"):
        if KERNELS in path.parents or str(path.relative_to(PACKAGE).with_suffix("")) in LAUNCHERS:
            continue
        modules = {i.split(".")[-1] for i in imports_of(path) if i in stages}
        launched = {
            ast.unparse(n.func)
            for n in nodes_of(path)
            if isinstance(n, ast.Call)
            and isinstance(n.func, ast.Attribute)
            and isinstance(n.func.value, ast.Name)
            and n.func.value.id in modules
        }
        assert not launched, f"{path.name} launches {launched}"


def structs():
    return [s for s in vars(state).values() if isinstance(s, type) and dataclasses.is_dataclass(s)]


def test_every_array_has_a_unit_or_a_meaning():
    declared = 0
    for path in (PACKAGE / "state").glob("*.py"):
        source = path.read_text().splitlines()
        for number, line in enumerate(source):
            if " = array(" in line:
                declared += 1
                assert source[number + 1].strip().startswith('"""'), (
                    f"{path.name}:{number + 1} has no docstring line"
                )
    assert declared == sum(len(dataclasses.fields(struct)) for struct in structs())


def test_structs_hold_arrays_only():
    for struct in structs():
        for declared in dataclasses.fields(struct):
            assert "shape" in declared.metadata, f"{struct.__name__}.{declared.name} is not an array"


def test_bytes_of_equals_what_allocate_takes():
    sizes = {"n_env": 3, "n_ray": 16}

    @dataclasses.dataclass(frozen=True, eq=False)
    class Probe:
        a: ti.Field = state.array("n_env", "n_ray", vec=3)
        b: ti.Field = state.array("n_env", dtype=ti.i16)

    probe = state.allocate(Probe, sizes)
    assert state.bytes_of(Probe, sizes) == probe.a.to_numpy().nbytes + probe.b.to_numpy().nbytes


def test_the_tree_in_contributing_shows_every_folder():
    block = re.search(r"<!-- tree -->\n```text\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.S)
    assert block, "CONTRIBUTING has no tree"
    drawn = set(re.findall(r"^ +([\w-]+/)", block.group(1), re.M))
    real = {
        f"{p.name}/"
        for p in [
            *PACKAGE.iterdir(), *KERNELS.iterdir(), *(PACKAGE / "learning").iterdir(),
            *(PACKAGE / "vehicle").iterdir(), *(PACKAGE / "logs").iterdir(),
        ]
        if p.is_dir() and p.name[0] != "_"
    }  # fmt: skip
    assert drawn == real, (
        f"CONTRIBUTING's tree lacks {sorted(real - drawn)} and still shows {sorted(drawn - real)}"
    )
    files = set(re.findall(r"[\w/]+\.py", block.group(1)))
    assert files <= {p.name for p in [*PACKAGE.rglob("*.py"), *ROOT.glob("*.py")]}


WITHOUT_TAICHI = """
import importlib, pkgutil, sys
sys.modules["taichi"] = None  # an import of it fails
for room in ("config", "learning", "logs", "report", "console"):
    package = importlib.import_module(f"uuvtai.{room}")
    for module in pkgutil.walk_packages(package.__path__, f"uuvtai.{room}."):
        importlib.import_module(module.name)
print(sum(name.startswith("uuvtai.") for name in sys.modules))
"""


def test_what_learns_records_and_reports_starts_no_taichi():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_TAICHI], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 80


def module_of(path):
    return ".".join(("uuvtai", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")


@cache
def nodes():
    """Module -> nodes of its syntax tree; not made at import, which every process of the gate does."""
    return {module_of(path): nodes_of(path) for path in sorted(PACKAGE.rglob("*.py"))}


def imports():
    """Module -> modules of ours that it imports, inside functions too."""
    found = {}
    for module, inside in nodes().items():
        named = set()
        for node in inside:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("uuvtai"):
                named |= {
                    f"{node.module}.{a.name}" if f"{node.module}.{a.name}" in nodes() else node.module
                    for a in node.names
                }
            elif isinstance(node, ast.Import):
                named |= {a.name for a in node.names if a.name.startswith("uuvtai")}
        found[module] = named - {module}
    return found


def circle_in(graph):
    """Modules along one circle of a graph, or nothing."""
    left = {node: {other for other in others if other in graph} for node, others in graph.items()}
    while free := [node for node, others in left.items() if not others & left.keys()]:
        for node in free:
            del left[node]
    return sorted(left)


def test_no_module_imports_itself_by_a_detour():
    graph = imports()
    assert sum(map(len, graph.values())) > 900
    assert not circle_in(graph)


@pytest.mark.parametrize(
    "graph", [{"a": {"b"}, "b": {"a"}}, {"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}]
)
def test_a_circle_would_be_found(graph):
    assert {"a", "b"} <= set(circle_in(graph))


@cache
def defined_in(module):
    """Names that a module's own text defines, wherever in it."""
    found = set()
    for node in nodes()[module]:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.ImportFrom | ast.Import):
            found |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
    return found


def test_what_is_imported_is_there():
    """Also inside functions and under conditions, which no other test may come by."""
    missing = [
        f"{module} imports {node.module}.{alias.name}"
        for module, inside in nodes().items()
        for node in inside
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("uuvtai")
        for alias in node.names
        if f"{node.module}.{alias.name}" not in nodes() and alias.name not in defined_in(node.module)
    ]
    assert not missing


def test_every_place_of_the_walk_through_the_rooms_is_there():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    walk = text[text.index("## A walk through the rooms") : text.index("## Recipes")]
    places = re.findall(r"`([\w/]+)\.py(?::(\w+))?`", walk)
    assert len(places) > 30
    for path, function in places:
        inside = nodes()[f"uuvtai.{path.replace('/', '.')}"]
        names = {node.name for node in inside if isinstance(node, ast.FunctionDef)}
        assert not function or function in names, f"{path}.py has no {function}"
