"""Pages from disk in headless Chromium, at two widths, light and dark (``js/look.mjs``), and Node."""

import functools
import json
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

JS = Path(__file__).parent / "js"
VIEWS = [(width, scheme) for width in (1400, 390) for scheme in ("light", "dark")]


def look(*pages):
    """What the browser met, by (page, width, scheme). Skips where there is no browser."""
    return {(one["page"], one["width"], one["scheme"]): one for one in told("look.mjs", *pages)["seen"]}


def require():
    """Skips where there is no browser."""
    if not (JS / "node_modules/@sparticuz").is_dir():
        pytest.skip("needs node and `npm ci` in tests/js (bootstrap.py does it)")
    if (platform.system(), platform.machine()) != ("Linux", "x86_64") and "CHROME_PATH" not in os.environ:
        pytest.skip("the packed Chromium is for Linux on x86_64: set CHROME_PATH to another one")


def told(script, *arguments):
    """What a script says of pages in a browser. Skips where there is none."""
    require()
    done = node(script, *map(str, arguments), TMPDIR=_unpacked().name)
    if done.returncode == 3:
        pytest.skip(f"Chromium does not start here: {done.stderr.strip().splitlines()[0]}")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@functools.cache
def _unpacked():
    """Where Chromium is unpacked to, which takes three seconds: once in a process."""
    return tempfile.TemporaryDirectory()


def node(*arguments, **environment):
    """What Node did in ``js``. Skips where there is none."""
    found = shutil.which("node")
    if found is None:
        pytest.skip("needs node (bootstrap.py brings one)")
    return subprocess.run(
        [found, *arguments], cwd=JS, env={**os.environ, **environment}, capture_output=True, text=True,
        check=False, timeout=500,
    )  # fmt: skip


def brightness(colour):
    """Sum of the channels of a CSS colour, 0 (black) to 765 (white)."""
    return sum(int(part) for part in colour.removeprefix("rgb(").removesuffix(")").split(","))
