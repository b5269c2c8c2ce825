"""What every Taichi function reads, writes, does and calls: read off the source."""

import ast
import dataclasses
import importlib
from functools import cache
from pathlib import Path

from uuvtai.sim.stages import members_of

KERNELS = Path(__file__).parent.parent / "uuvtai/kernels"
FILES = sorted(path for path in KERNELS.rglob("*.py") if path.stem not in ("__init__", "io"))
ROOMS = sorted(path.name for path in KERNELS.iterdir() if path.is_dir() and path.name[0] != "_")


def module_of(path):
    return ".".join(("uuvtai", *path.relative_to(KERNELS.parent).with_suffix("").parts))


def bundles():
    """Every bundle of every room, by name."""
    found = {}
    for room in ROOMS:
        if (KERNELS / room / "io.py").exists():
            module = importlib.import_module(f"uuvtai.kernels.{room}.io")
            found |= {
                name: kind
                for name, kind in vars(module).items()
                if dataclasses.is_dataclass(kind)
                and kind.__module__ == module.__name__
                and not name.endswith("Stages")  # the list of the room's bundles
            }
    return found


BUNDLES = bundles()


@dataclasses.dataclass
class Function:
    """A kernel or func."""

    path: Path
    node: ast.FunctionDef
    calls: dict  # called name -> (module, name) where it is one of ours

    @property
    def name(self):
        return self.node.name

    def marks(self):
        """'vehicle' or 'io.vehicle' -> ('In', 'VehicleState'), for all that is handed over."""
        found = {}
        for argument in self.node.args.args:
            mark, kind = mark_of(argument)
            if mark == "Bundle":
                for member in dataclasses.fields(BUNDLES[kind]):
                    found[f"{argument.arg}.{member.name}"] = (
                        str(member.type).partition("[")[0],
                        members_of(BUNDLES[kind])[member.name],
                    )
            elif mark:
                found[argument.arg] = (mark, kind)
        return found


def mark_of(argument):
    """('In', 'WorldState') of an argument annotated In[WorldState]."""
    a = argument.annotation
    if (
        isinstance(a, ast.Subscript)
        and isinstance(a.value, ast.Name)
        and a.value.id in ("In", "Out", "Const", "Bundle")
    ):
        return a.value.id, ast.unparse(a.slice)
    return None, None


def decorated(node):
    return {ast.unparse(d) for d in node.decorator_list}


def is_kernel(node):
    return "ti.kernel" in decorated(node)


@cache
def functions():
    """(module, name) -> Function of all kernel files; not made at import, which every process does."""
    found = {}
    for path in FILES:
        tree = ast.parse(path.read_text())
        own = {n.name: (module_of(path), n.name) for n in tree.body if isinstance(n, ast.FunctionDef)}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("uuvtai.kernels."):
                own |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and decorated(node) & {"ti.kernel", "ti.func"}:
                found[module_of(path), node.name] = Function(path, node, own)
    return found


def root_of(node):
    """'io.vehicle' of io.vehicle.pos_w[env], 'words' of words[i], '' of what is no name."""
    chain = []
    while isinstance(node, ast.Attribute | ast.Subscript):
        if isinstance(node, ast.Attribute):
            chain.append(node.attr)
        node = node.value
    if not isinstance(node, ast.Name):
        return ""
    return f"io.{chain[-1]}" if node.id == "io" and chain else node.id


def written(function):
    """(root, line) of every array that a function stores into: by assignment, by an atomic operation."""
    for node in ast.walk(function.node):
        targets = (
            node.targets
            if isinstance(node, ast.Assign)
            else [node.target]
            if isinstance(node, ast.AugAssign)
            else []
        )
        for target in [
            one for t in targets for one in (t.elts if isinstance(t, ast.Tuple | ast.List) else [t])
        ]:
            if isinstance(target, ast.Subscript | ast.Attribute):
                yield root_of(target), node.lineno
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith("ti.atomic"):
            yield root_of(node.args[0]), node.lineno


def handed(function):
    """(root, mark of its parameter, called name, line) of every struct or section that is passed on."""
    for node in ast.walk(function.node):
        if not (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and function.calls.get(node.func.id) in functions()
        ):
            continue
        called = functions()[function.calls[node.func.id]]
        for given, parameter in zip(node.args, called.node.args.args, strict=True):
            mark, kind = mark_of(parameter)
            if mark:
                yield root_of(given), mark, kind, called.name, node.lineno
