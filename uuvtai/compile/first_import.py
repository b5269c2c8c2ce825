"""What must be in place before Taichi is imported: it decorates hundreds of functions of its own then, and
for each searches all loaded modules for the source of the frame around it."""

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
    if _MODULE not in sys.modules and not any(isinstance(one, TaichiFinder) for one in sys.meta_path):
        sys.meta_path.insert(0, TaichiFinder())  # type: ignore[arg-type]
