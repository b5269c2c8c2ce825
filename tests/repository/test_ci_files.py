"""What runs elsewhere (GitHub, a container, a contributor's hooks) agrees with this checkout."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import bootstrap
import uuvtai
from tests.conftest import BEGUN_FIRST

ROOT = Path(__file__).parents[2]
WORKFLOW = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
PROJECT = (ROOT / "pyproject.toml").read_text()
PYTHONS = ["3.10", "3.11", "3.12", "3.13"]
LOCKED = r"(?m)^([A-Za-z0-9][^=\s]*==[^\\\n]+?) \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)"


def steps_of(job):
    return WORKFLOW["jobs"][job]["steps"]


def wanted():
    """Every requirement of the project and its extras, but for the extras that it names itself."""
    lists = PROJECT[PROJECT.index("dependencies = [") : PROJECT.index("[project.scripts]")]
    lines = re.findall(r'"([A-Za-z][^"]*)"', re.sub(r"(?m)(?<=[\],])\s*#.*$", "", lists))
    return [Requirement(line) for line in lines if not line.startswith("uuvtai[")]


def locked():
    """Pinned requirements of CI's lock by name; one name may have several, for different interpreters."""
    pins = {}
    for line, _hashes in re.findall(LOCKED, (ROOT / ".ci/requirements.lock").read_text()):
        pin = Requirement(line)
        pins.setdefault(canonicalize_name(pin.name), []).append(pin)
    return pins


def test_every_line_of_the_lock_is_a_pin_with_hashes_from_an_ordinary_index():
    text = (ROOT / ".ci/requirements.lock").read_text()
    rest = re.sub(LOCKED, "", text)
    assert all(line.startswith("#") for line in rest.splitlines() if line), rest[:300]
    assert "://" not in text and "/work" not in text


@pytest.mark.parametrize("python", PYTHONS)
def test_the_lock_has_what_the_project_wants(python):
    """On Linux, where CI runs it; where this fails, renew the lock (CONTRIBUTING.md)."""
    place = {
        "python_version": python,
        "python_full_version": f"{python}.9",
        "sys_platform": "linux",
        "platform_machine": "x86_64",
    }
    pins, requirements = locked(), wanted()
    assert len(requirements) > 30
    for requirement in requirements:
        if requirement.marker and not requirement.marker.evaluate(place):
            continue
        fitting = [
            pin
            for pin in pins.get(canonicalize_name(requirement.name), [])
            if not pin.marker or pin.marker.evaluate(place)
        ]
        assert len(fitting) == 1, f"{requirement}: the lock has {fitting}"
        (version,) = (spec.version for spec in fitting[0].specifier)
        assert requirement.specifier.contains(version), f"{requirement}: the lock has {version}"


def test_ci_runs_the_gate_on_every_python_that_is_promised():
    assert WORKFLOW["jobs"]["test"]["strategy"]["matrix"]["python"] == PYTHONS
    assert 'requires-python = ">=3.10,<3.14"' in PROJECT
    runs = [step.get("run", "") for step in steps_of("test")]
    assert runs[-1] == ".ci/run" and "bootstrap.py test" in (ROOT / runs[-1]).read_text()
    assert any("--require-hashes --requirement .ci/requirements.lock" in run for run in runs)


def test_the_processes_of_the_gate_keep_the_bytecode_they_compile(monkeypatch):
    """Also where the environment forbids it: packages bring none, and hundreds of processes start."""
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    monkeypatch.setattr(sys, "argv", ["bootstrap.py", "test"])
    monkeypatch.setattr(bootstrap, "test", lambda _: int("PYTHONDONTWRITEBYTECODE" in os.environ))
    assert bootstrap.main() == 0


def test_files_that_are_begun_first_are_here():
    there = {path.stem for path in (ROOT / "tests").rglob("test_*.py")}
    assert {f"test_{name}" for name in BEGUN_FIRST.split()} <= there


def test_settings_of_pip_are_told_to_uv_and_the_nearer_ones_count():
    listed = """:env:.find-links='/a/wheels /b/wheels'
:env:.disable-pip-version-check='1'
global.cert='/etc/ssl/ours.crt'
global.extra-index-url='https://a.example/simple\\nhttps://b.example/simple'
global.find-links='/c/wheels'
install.index-url='https://c.example/simple'
list.format='columns'
"""
    assert bootstrap.settings_of_uv(listed) == {
        "SSL_CERT_FILE": "/etc/ssl/ours.crt",
        "UV_INDEX": "https://a.example/simple https://b.example/simple",
        "UV_FIND_LINKS": "/a/wheels,/b/wheels",
        "UV_DEFAULT_INDEX": "https://c.example/simple",
    }
    assert bootstrap.settings_of_uv("") == {}
    assert bootstrap.settings_of_uv("global.only-binary=':all:'\n") is None


@pytest.mark.parametrize("fails", ["config", "uv>=0.5,<1", "--python", None])
def test_pip_installs_what_uv_cannot(fails, monkeypatch, tmp_path, capsys):
    ran = []

    def run(command, **_how):
        ran.append([str(word) for word in command])
        return subprocess.CompletedProcess(command, int(fails in ran[-1]), "", "no such wheel")

    monkeypatch.setattr(bootstrap, "VENV", tmp_path)
    monkeypatch.setattr(bootstrap, "BIN", tmp_path)
    monkeypatch.setattr(bootstrap.subprocess, "run", run)
    bootstrap.install(".[dev]")
    by_pip = [bootstrap.PIP[0], "-m", "pip", "install", "--quiet", "--no-compile", "--editable", ".[dev]"]
    assert (by_pip in ran) == bool(fails)
    told = capsys.readouterr().err
    assert ("no such wheel" in told) == ("pip does it" in told) == (fails == "--python")
    assert (tmp_path / ".installed-dev").exists()
    ran.clear()
    bootstrap.install(".[dev]")
    assert ran == [], "nothing has changed since"


def test_ci_names_files_that_are_here():
    text = (ROOT / ".github/workflows/ci.yml").read_text()
    named = re.findall(r"hashFiles\((.*?)\)", text)
    globs = [glob for arguments in named for glob in re.findall(r"'([^']+)'", arguments)]
    assert globs and all(any(ROOT.glob(glob)) for glob in globs)
    assert all((ROOT / place).exists() for place in re.findall(r"\.ci/[\w.]+", text))


def test_what_others_wrote_is_pinned():
    uses = [step["uses"] for job in WORKFLOW["jobs"] for step in steps_of(job) if "uses" in step]
    assert uses and all(re.fullmatch(r"actions/[\w-]+@v\d+", used) for used in uses)
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert hooks and all(re.fullmatch(r"v?\d+\.\d+\.\d+", repo["rev"]) for repo in hooks)


def test_other_systems_install_and_run_an_episode_and_hold_up_no_release():
    job = WORKFLOW["jobs"]["elsewhere"]
    assert {name.partition("-")[0] for name in job["strategy"]["matrix"]["os"]} == {"macos", "windows"}
    assert "uuv eval" in steps_of("elsewhere")[-1]["run"]
    assert "elsewhere" not in WORKFLOW["jobs"]["release"]["needs"]
    linux_only = {str(r.marker) for r in wanted() if r.name in ("ompl", "llvmlite")}
    assert linux_only == {'sys_platform == "linux"'}


def test_the_release_waits_for_tests_and_build_and_needs_a_tag():
    release = WORKFLOW["jobs"]["release"]
    assert set(release["needs"]) == {"test", "build", "docs"} and "refs/tags/v" in release["if"]
    assert WORKFLOW["permissions"] == {"contents": "read"}


def test_the_image_is_made_of_files_that_docker_is_shown_and_runs_as_nobody_special():
    text = (ROOT / "Dockerfile").read_text()
    shown = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {name for line in re.findall(r"(?m)^COPY (?!--from)(.+) \S+$", text) for name in line.split()}
    assert copied == shown and all((ROOT / name).exists() for name in copied)
    assert re.findall(r"(?m)^USER (\d+)$", text) and not re.findall(r"(?m)^USER (root|0)$", text)
    torch = next(requirement for requirement in wanted() if requirement.name == "torch")
    assert Requirement(re.findall(r'"(torch[^"]*)"', text)[0]) == torch


def test_the_citation_is_of_this_version_and_licence():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors", "version", "license"} <= cited.keys()
    assert (str(cited["version"]), cited["license"]) == (uuvtai.__version__, "MIT")
    assert "Partial Observability" in cited["message"]
    assert "CITATION.cff" in (ROOT / "MANIFEST.in").read_text()
