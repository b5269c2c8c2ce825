"""The house stays as drawn: who may import whom, who may see the truth, what a kernel file may contain."""

import ast
import dataclasses
import re
from pathlib import Path

import pytest
import taichi as ti

from uuvtai import state

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "uuvtai"
KERNELS = sorted((PACKAGE / "kernels").glob("*.py"))

LENT = {"elevation", "recording", "tree_tick"}
"""Files with a kernel that lend their functions to stages too."""
WITH_KERNELS = {p.stem for p in KERNELS if "@ti.kernel" in p.read_text()}
STAGES = WITH_KERNELS - LENT
FLOOR = {p.stem for p in KERNELS} - STAGES
"""Kernel files that stages may import: all that are no stage themselves."""

SIMULATOR_SIDE = {
    "actuation", "debug_stamp", "debug_tracks", "depth", "dynamics", "episode", "proprioception", "reward", "sonar", "world",
    "bodies", "hull", "layout", "paths", "raycast", "sonar_error", "rotor",
}  # fmt: skip
"""Files that may see the truth; every other kernel file is part of the stack and may not."""
OBSERVATION_ONLY = {p.stem for p in KERNELS} - SIMULATOR_SIDE
TRUTH = {
    "WorldState", "PathState", "VehicleState", "VehicleParams", "CurrentState", "SceneState", "RefereeState", "EpisodeState",
    "FixedTable", "ScenarioScratch", "WorldConfig", "ProprioceptionMemory", "SonarMemory", "ActuationState",
}  # fmt: skip


def tree_of(path):
    return ast.parse(path.read_text())


def names_in(path):
    """Every identifier and attribute that a file mentions in code."""
    tree = tree_of(path)
    return (
        {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
        | {a.name for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) for a in n.names}
        | {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    )


def imports_of(path):
    found = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def functions_of(path):
    return [n for n in ast.walk(tree_of(path)) if isinstance(n, ast.FunctionDef)]


def is_kernel(function):
    return any(ast.unparse(d) == "ti.kernel" for d in function.decorator_list)


def marker_of(argument):
    """('In', 'WorldState') of an argument annotated In[WorldState]."""
    a = argument.annotation
    if isinstance(a, ast.Subscript) and isinstance(a.value, ast.Name):
        return a.value.id, ast.unparse(a.slice)
    return None, None


def test_there_are_observation_only_stages_to_check():
    present = {p.stem for p in KERNELS}
    assert {"tracking", "forecast", "elevation", "look", "mapping", "clearance", "voronoi", "route", "features"} <= OBSERVATION_ONLY
    assert {"threats", "evasion", "rollout", "teacher", "tree_tick"} <= OBSERVATION_ONLY
    assert present >= SIMULATOR_SIDE, f"gone: {SIMULATOR_SIDE - present}"
    assert {"WorldState", "VehicleState"} <= {struct.__name__ for struct in structs()}


@pytest.mark.parametrize("path", [p for p in KERNELS if p.stem in OBSERVATION_ONLY], ids=lambda p: p.stem)
def test_observation_only_stages_never_name_the_truth(path):
    assert not names_in(path) & TRUTH


@pytest.mark.parametrize("path", KERNELS, ids=lambda p: p.stem)
def test_kernels_import_taichi_and_the_floor_only(path):
    own = {i for i in imports_of(path) if i.startswith("uuvtai.")}
    assert "import uuvtai\n" not in path.read_text(), f"{path.name} imports the whole package"
    foreign = {i.split(".")[0] for i in imports_of(path)} - {"uuvtai", "taichi", "typing", "math"}
    assert not foreign, f"{path.name} imports {foreign}"
    for module in own:
        parts = module.split(".")
        if parts[:2] == ["uuvtai", "kernels"] and len(parts) > 2:
            assert parts[2] in FLOOR, f"{path.name} imports the stage {parts[2]}"
        else:
            assert parts[1] in ("state", "config", "kernels", "front_end", "tree_codes"), f"{path.name} imports {module}"


def test_kernel_files_lend_functions_never_kernels():
    """A kernel is launched by the simulator, in its order; what two files share is a function."""
    kernels = {f"uuvtai.kernels.{path.stem}.{function.name}" for path in KERNELS for function in functions_of(path) if is_kernel(function)}
    assert len(kernels) > 30
    for path in KERNELS:
        assert not imports_of(path) & kernels, f"{path.name} imports {imports_of(path) & kernels}"


@pytest.mark.parametrize("path", KERNELS, ids=lambda p: p.stem)
def test_kernel_files_stay_in_the_safe_subset(path):
    text = path.read_text()
    assert "from __future__ import annotations" not in text, "Taichi needs real annotations"
    for call in (n for n in ast.walk(tree_of(path)) if isinstance(n, ast.Call)):
        name = ast.unparse(call.func)
        assert name not in ("ti.random", "ti.randn", "ti.init", "print"), f"{path.name}:{call.lineno} calls {name}"


@pytest.mark.parametrize("path", KERNELS, ids=lambda p: p.stem)
def test_a_kernel_never_writes_what_it_only_reads(path):
    for function in functions_of(path):
        read_only = {a.arg for a in function.args.args if marker_of(a)[0] in ("In", "Const")}
        for node in ast.walk(function):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AugAssign) else []
            for target in targets:
                root = target
                while isinstance(root, ast.Attribute | ast.Subscript):
                    root = root.value
                if isinstance(target, ast.Subscript | ast.Attribute) and isinstance(root, ast.Name) and function.name[0] != "_":
                    assert root.id not in read_only, f"{path.name}:{node.lineno} {function.name} writes {root.id}"


@pytest.mark.parametrize("path", KERNELS, ids=lambda p: p.stem)
def test_every_kernel_says_what_it_reads_and_writes(path):
    for function in functions_of(path):
        if not is_kernel(function):
            continue
        assert ast.get_docstring(function), f"{path.name}: {function.name} has no docstring"
        for argument in function.args.args:
            assert argument.annotation is not None, f"{path.name}: {function.name}({argument.arg}) is not annotated"


def test_only_the_runtime_starts_taichi():
    for path in PACKAGE.rglob("*.py"):
        calls = [ast.unparse(n.func) for n in ast.walk(tree_of(path)) if isinstance(n, ast.Call)]
        assert ("ti.init" in calls) == (path.name == "runtime.py")


def test_only_sim_plant_and_the_fallback_launch_kernels():
    for path in PACKAGE.rglob("*.py"):
        if path.parent.name == "kernels" or path.stem in ("sim", "plant", "rrt"):
            continue
        launched = {
            ast.unparse(n.func)
            for n in ast.walk(tree_of(path))
            if isinstance(n, ast.Call)
            and isinstance(n.func, ast.Attribute)
            and isinstance(n.func.value, ast.Name)
            and n.func.value.id in WITH_KERNELS
        }
        imported = {i for i in imports_of(path) if i.startswith("uuvtai.kernels.") and i.split(".")[-1] in WITH_KERNELS}
        assert not (launched and imported), f"{path.name} launches {launched}"


def structs():
    return [s for s in vars(state).values() if isinstance(s, type) and dataclasses.is_dataclass(s)]


def test_every_array_has_a_unit_or_a_meaning():
    declared = 0
    for path in (PACKAGE / "state").glob("*.py"):
        source = path.read_text().splitlines()
        for number, line in enumerate(source):
            if " = array(" in line:
                declared += 1
                assert source[number + 1].strip().startswith('"""'), f"{path.name}:{number + 1} has no docstring line"
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


def test_readme_tree_equals_the_real_one():
    text = (ROOT / "README.md").read_text()
    block = re.search(r"<!-- tree -->\n```[a-z]*\n(.*?)```", text, re.S)
    assert block, "README has no tree"
    drawn = set(re.findall(r"([\w./-]+\.py|[\w-]+/)", block.group(1)))
    real = {p.name for p in PACKAGE.rglob("*.py") if p.stem != "__init__"} | {
        f"{p.name}/" for p in PACKAGE.iterdir() if p.is_dir() and p.name[0] != "_"
    }
    missing = real - drawn
    gone = {name for name in drawn if name.endswith(".py")} - real - {p.name for p in ROOT.glob("*.py")}
    assert not missing and not gone, f"README's tree lacks {sorted(missing)} and still shows {sorted(gone)}"
