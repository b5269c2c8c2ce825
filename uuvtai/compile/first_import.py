"""What must be in place before Taichi is imported: it decorates hundreds of functions of its own then, and
for each searches all loaded modules for the source of the frame around it. And the switch to its maintained
fork, Quadrants, with all that only this needs: ``UUV_COMPILER=quadrants``."""

from __future__ import annotations

import os
import sys

_MODULE = "taichi.lang.kernel_impl"


def inside_class(level_of_class_stackframe: int) -> bool:
    """Whether a decorator is at work in the body of a class; ``level_of_class_stackframe`` is the frame that
    executes the class statement."""
    return "__qualname__" in sys._getframe(level_of_class_stackframe - 1).f_locals


class TaichiFinder:
    """Finds one module of Taichi, once, and gives it ``inside_class`` when it has run."""

    def find_spec(self, name, path=None, target=None):
        """As the import system asks; None for every other module."""
        if name != _MODULE:
            return None
        sys.meta_path.remove(self)  # type: ignore[arg-type]
        from importlib.util import find_spec

        spec = find_spec(name)
        loader = spec.loader if spec else None
        if loader is not None:
            run = loader.exec_module

            def run_and_patch(module):
                run(module)
                if hasattr(module, "_inside_class"):
                    module._inside_class = inside_class

            loader.exec_module = run_and_patch  # type: ignore[method-assign]
        return spec


def watch_for_taichi() -> None:
    """Have Taichi patched when it is imported, unless it is there already. Without a home folder its C++ ends
    the process: where the environment names none, it is the system's entry, or else the current folder."""
    if not os.environ.get("HOME"):
        os.environ.pop("HOME", None)
        home = os.path.expanduser("~")
        os.environ["HOME"] = os.getcwd() if home == "~" else home
    if (asked := os.environ.get("UUV_COMPILER") or "taichi") != "taichi":
        if "taichi" in sys.modules:
            raise ImportError("UUV_COMPILER: Taichi is imported already; import uuvtai before it")
        sys.meta_path.insert(0, StandIn(asked))  # type: ignore[arg-type]
    elif _MODULE not in sys.modules and not any(isinstance(one, TaichiFinder) for one in sys.meta_path):
        sys.meta_path.insert(0, TaichiFinder())  # type: ignore[arg-type]


class StandIn:
    """Finds and loads Quadrants where Taichi is asked for."""

    def __init__(self, asked: str) -> None:
        self._asked = asked

    def find_spec(self, name, path=None, target=None):
        """As the import system asks."""
        from importlib.machinery import ModuleSpec

        return ModuleSpec(name, self) if name == "taichi" else None  # type: ignore[arg-type]

    def create_module(self, spec):
        """Quadrants, whose modules have Taichi's names, too, from now on. Raises SettingError for another
        compiler, and where it is missing."""
        from uuvtai.common.errors import SettingError

        if self._asked != "quadrants":
            raise SettingError(f"UUV_COMPILER={self._asked!r}: must be taichi or quadrants; unset: taichi")
        os.environ.setdefault("ENABLE_QUADRANTS_HEADER_PRINT", "0")  # stdout belongs to results
        try:
            import quadrants
        except ImportError as error:
            raise SettingError(f"UUV_COMPILER=quadrants: {error}; pip install quadrants") from error
        self._own = quadrants.__spec__
        inner = [name for name in sys.modules if name.startswith("quadrants.")]
        sys.modules.update({"taichi" + name.removeprefix("quadrants"): sys.modules[name] for name in inner})
        return quadrants

    def exec_module(self, module):
        """It has run; the import system has just given it Taichi's spec."""
        module.__spec__ = self._own


def adapt_quadrants() -> None:
    """Give Quadrants what this package asks of Taichi 1.7.4 and finds no more, before it is started."""
    import dataclasses
    from types import SimpleNamespace
    from typing import Any

    from quadrants.lang.kernel import Kernel

    from uuvtai.compile.launch import TaichiLaunch, native

    class Plain:
        """Members of a dataclass: where it is a template's argument, Quadrants takes it apart."""

    def plain(value):
        if not dataclasses.is_dataclass(value) or isinstance(value, type):
            return value
        kept = vars(value)
        if "_plain" not in kept:
            made = kept["_plain"] = Plain()
            vars(made).update({member.name: plain(kept[member.name]) for member in dataclasses.fields(value)})
        return kept["_plain"]

    def found(_launch, kernel):
        """A kernel that was just launched, and its code."""
        key = kernel._last_launch_key
        return kernel.materialized_kernels[key], kernel.compiled_kernel_data_by_key[key]

    kind: Any = Kernel
    compiled = kind.ensure_compiled
    kind.ensure_compiled = lambda kernel, *arguments: compiled(kernel, *map(plain, arguments))
    kind.arguments = property(lambda kernel: kernel.arg_metas)
    kind.compiled_kernels = property(lambda kernel: kernel.materialized_kernels)
    TaichiLaunch._found, TaichiLaunch.place = found, int  # type: ignore[method-assign]
    native.append(SimpleNamespace(first=lambda *_: None, adopt=lambda *_: None, made=0, found=0))
