"""The command line answers quickly: what help, completion and light commands import, and what completion offers."""

import subprocess
import sys

import pytest


def modules_after(*arguments, **environment):
    """(exit code, modules loaded) of a command in a process of its own."""
    program = (
        "import sys\nfrom uuvtai.cli import main\n"
        f"try: main({list(arguments)})\nexcept SystemExit as left: print('left', left.code, *sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    _left, code, *modules = done.stderr.splitlines()[-1].split()
    return int(code), set(modules)


@pytest.mark.parametrize("arguments", [["tree"], ["tree", "--dot", "--controller", "planner"], ["tree", "--json"]])
def test_a_tree_is_printed_without_torch_and_taichi(arguments):
    code, modules = modules_after(*arguments)
    assert code == 0
    assert not {"torch", "taichi", "cv2"} & modules
