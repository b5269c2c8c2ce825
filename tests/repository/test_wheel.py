"""The wheel of the source distribution in an environment of its own, anywhere, without a network."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

from tests.small_sim import SmallSim

ROOT = Path(__file__).parents[2]
KEPT = ("uuvtai", "tests", "benchmarks", "examples", "docs", "runs/README.md", ".ci", ".github")
"""of the checkout, beside the files at its top"""
PRESETS = {
    path.relative_to(ROOT).as_posix() for path in (ROOT / "uuvtai" / "presets").rglob("*") if path.is_file()
}
EXAMPLES = {path.name for path in (ROOT / "examples").iterdir() if path.is_file()}
MODULES = {
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "uuvtai").rglob("*")
    if path.suffix in (".py", ".mjs")
}

NO_NETWORK = """
import pathlib, sys

def refuse(event, arguments):
    sends = event in ("socket.connect", "socket.sendto", "socket.sendmsg")
    if sends and isinstance(arguments[1], tuple) or event in ("socket.getaddrinfo", "socket.gethostbyname"):
        with open(pathlib.Path(__file__).with_suffix(".log"), "a") as log:
            log.write(f"{event} {arguments}\\n")
        raise OSError(f"no network in this environment: {event}")

sys.addaudithook(refuse)
"""
"""Module of the wheel's environment: whatever reaches for another machine fails, and is written down in case
nobody tells."""


def run(*command, **options):
    """One command that must succeed; its stdout."""
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, check=False, **options
    )
    assert done.returncode == 0, f"{command}: {done.stderr[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """(source distribution, wheel made from it), built from a copy of the checkout."""
    place = tmp_path_factory.mktemp("built")
    copy, dist = place / "checkout", place / "dist"
    for name in [*KEPT, *(path.name for path in ROOT.iterdir() if path.is_file())]:
        source = ROOT / name
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, copy / name, ignore=shutil.ignore_patterns("node_modules", "__pycache__"))
        elif source.exists():
            shutil.copy(source, copy / name)
    dist.mkdir()
    build = "import sys, setuptools.build_meta as b; getattr(b, sys.argv[1])(sys.argv[2])"
    run(sys.executable, "-c", build, "build_sdist", dist, cwd=copy)
    (sdist,) = dist.glob("*.tar.gz")
    shutil.unpack_archive(sdist, place / "unpacked")
    (unpacked,) = (place / "unpacked").iterdir()
    run(sys.executable, "-c", build, "build_wheel", dist, cwd=unpacked)
    (stepper,) = dist.glob("*.whl")
    return sdist, stepper


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory):
    """(packages, interpreter) of an environment with the wheel, lent the rest; no network there."""
    place = tmp_path_factory.mktemp("installed")
    run(sys.executable, "-m", "venv", "--without-pip", place)
    python = next(place.glob("*/python"), None) or place / "Scripts" / "python.exe"
    own = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    (own / "lent.pth").write_text(sysconfig.get_path("purelib") + "\n")
    run(
        python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--ignore-installed", built[1],
        env=clean(), cwd=place,
    )  # fmt: skip
    (own / "no_network.py").write_text(NO_NETWORK)
    (own / "no_network.pth").write_text("import no_network\n")
    return own, python


def clean(**more):
    """The environment of a user: nothing of the checkout in it."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | more


IN_TURN = """
import contextlib, io, json, os, sys
import uuvtai
from uuvtai.cli import main
told = {"where": uuvtai.__file__}
for line in json.loads(sys.argv[1]):
    if line.startswith("eval"):
        os.environ["XDG_CACHE_HOME"] = sys.argv[2]
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        try:
            main(line.split())
        except SystemExit as left:
            assert not left.code, (line, left.code)
    told[line] = out.getvalue()
print(json.dumps(told))
"""
EVALUATION = " ".join(("eval --agent bt --episodes 2 --seeds 3", *SmallSim.OPTIONS, "--json"))


@pytest.fixture(scope="module")
def told(installed, tmp_path_factory):
    """What commands of the wheel say, in turn in one process, by their words, and where it lies; in an empty
    folder and a home without Taichi's cache, where Taichi would ask for its newest version at once. Kernels
    of the evaluation are found compiled. Fails where anything asked the network."""
    own, python = installed
    place = tmp_path_factory.mktemp("home")
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    lines = ["--help", "presets --json", "presets show tree/bt --all", "doctor --json", EVALUATION]
    home = {"HOME": str(place), "USERPROFILE": str(place), "XDG_CACHE_HOME": ""}
    out = run(python, "-c", IN_TURN, json.dumps(lines), cache, cwd=place, env=clean(**home))
    asked = own / "no_network.log"
    assert not asked.exists(), asked.read_text()
    return json.loads(out.splitlines()[-1])


def test_the_wheel_holds_the_package_and_the_examples_and_nothing_else(built):
    names = set(zipfile.ZipFile(built[1]).namelist())
    info = {name for name in names if name.split("/")[0].endswith(".dist-info")}
    beside = {name for name in names if ".data/" in name}
    assert {name.partition("/data/")[2] for name in beside} == {
        f"share/uuvtai/examples/{n}" for n in EXAMPLES
    }
    assert names - info - beside == MODULES | PRESETS | {"uuvtai/py.typed", "uuvtai/report/page.html.j2"}
    assert any(name.endswith("licenses/LICENSE") for name in info)


def test_the_source_distribution_can_be_tested_and_carries_no_litter(built):
    with tarfile.open(built[0]) as packed:
        names = {name.partition("/")[2] for name in packed.getnames()}
    wanted = {
        "LICENSE", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "pyproject.toml", "bootstrap.py",
        "tests/conftest.py", ".ci/run",
    }  # fmt: skip
    assert names >= wanted | MODULES | PRESETS | {
        "tests/oracles/world.py",
        "examples/judge.py",
        "benchmarks/run.py",
    }
    assert not [
        name
        for name in names
        if "node_modules" in name or "__pycache__" in name or name.startswith(("build/", "runs/2"))
    ]


def test_the_commands_are_the_wheels_and_work_in_any_folder(installed, told):
    assert Path(told["where"]).parent == installed[0] / "uuvtai"
    assert "observation-only navigation" in told["--help"]
    listed = json.loads(told["presets --json"])
    assert "pool" in listed["world"] and "bt" in listed["tree"]
    assert "BTCPP_format" in told["presets show tree/bt --all"]


def test_the_examples_are_a_users_by_one_command_and_none_of_hers_is_overwritten(installed, tmp_path):
    own = [installed[1].with_name("uuv"), "examples"]
    said = run(*own, cwd=tmp_path, env=clean()).split()
    assert {Path(name).name for name in said} == EXAMPLES
    mine = tmp_path / "examples" / "own_astar.py"
    assert mine.read_bytes() == (ROOT / "examples" / "own_astar.py").read_bytes()
    mine.write_text("# hers")
    again = subprocess.run(own, capture_output=True, text=True, check=False, cwd=tmp_path, env=clean())
    assert again.returncode == 2 and "uuv examples NEW" in again.stderr and mine.read_text() == "# hers"


def test_who_reaches_for_the_network_is_found_out(installed, tmp_path):
    """Look-ups and connections fail and are written down, even if the errors are swallowed."""
    own, python = installed
    tries = (
        "s.create_connection(('192.0.2.1', 9), 1)",
        "s.getaddrinfo('uuvtai.invalid', 9)",
        "s.socket(type=s.SOCK_DGRAM).sendto(b'', ('192.0.2.1', 9))",
    )
    for attempt in tries:
        program = f"import socket as s\ntry: {attempt}\nexcept OSError as error: print(error)"
        assert "no network in this environment" in run(python, "-c", program, cwd=tmp_path, env=clean())
    log = own / "no_network.log"
    assert len(log.read_text().splitlines()) >= len(tries)
    log.unlink()


def test_doctor_and_an_evaluation_ask_no_server(told):
    assert json.loads(told["doctor --json"])["ok"]
    assert sum(json.loads(told[EVALUATION])["agents"][0]["outcomes"].values()) == 2
