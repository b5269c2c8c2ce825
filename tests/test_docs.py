"""The documentation: the site builds without a warning, no page is missing, what readers are told to type
works, the tutorial runs."""

import itertools
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from docs.writers import commands, configuration, stages, topics
from uuvtai.cli import main
from uuvtai.config.learning import LearningConfig

ROOT = Path(__file__).parents[1]
PROSE = sorted(
    [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").glob("*.md"),
        ROOT / "benchmarks/README.md",
        ROOT / "runs/README.md",
    ]
)
NOTEBOOK = ROOT / "examples/tutorial.ipynb"

FENCE = re.compile(r"^(<!-- (?P<mark>run) -->\n)?```(?P<language>\w*)\n(?P<body>.*?)^```", re.M | re.S)
SPAN = re.compile(r"`(uuv [^`]+)`")
PATH = re.compile(r"`((?:docs|examples|tests|uuvtai|benchmarks)/[\w./-]+\.\w+)`")
ADDRESS = re.compile(r"https?://[^\s<>)\]`\"']+")
LINK = re.compile(r"(?<!`)\[[^\]]*\]\((?!https?:)([^)#\s]+)")
NUMBERS = {"N", "K", "S"}
"""what stands for a number in a line of usage"""


# ------------------------------------------------------------------------------------------------------- site


def test_the_site_builds_without_a_warning_and_lacks_no_page(tmp_path):
    """Broken internal links and anchors are warnings of Sphinx, and warnings are errors here."""
    pytest.importorskip("myst_parser", reason="the extra docs is not installed")
    shutil.copytree(
        ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("reference", "__pycache__")
    )
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "docs", "site"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    built = {
        str(page.relative_to(tmp_path / "site").with_suffix(""))
        for page in (tmp_path / "site").rglob("*.html")
    }
    assert {f"reference/commands/{name}" for name in commands.app().commands} <= built
    assert {f"reference/configuration/{name}" for name in LearningConfig.model_fields} <= built
    assert {path.stem for path in (ROOT / "docs").glob("*.md")} <= built
    of_eval = (tmp_path / "site/reference/commands/eval.html").read_text()
    assert "[default: runs/TIME_PRESET]" in of_eval and "With --explain:" in of_eval, (
        "help texts are shown as they are"
    )
    assert (
        "overflow-x: auto" in (tmp_path / "site/_static/custom.css").read_text() and "custom.css" in of_eval
    )
    assert 'id="uuvtai.make"' in (tmp_path / "site/python.html").read_text()


def test_generated_pages_are_not_committed():
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    assert {"docs/reference/", "site/"} <= set(ignored)


def test_every_command_tells_its_options():
    found = commands.pages()
    for name, command in commands.app().commands.items():
        for option in itertools.chain.from_iterable(
            parameter.opts for parameter in command.params if parameter.opts[0].startswith("-")
        ):
            assert (
                f"`{option}" in found[f"commands/{name}.md"] or f", {option}" in found[f"commands/{name}.md"]
            )
    assert "`uuv log repair" in found["commands/log.md"] and "| 130 |" in found["commands.md"]


def test_every_key_has_a_row_with_type_default_unit_and_meaning():
    found = configuration.pages()
    for section in LearningConfig.model_fields:
        for key in configuration.section(section).model_fields:
            assert (
                f"`{key}`" in found[f"configuration/{section}.md"]
                or f"`{section}.{key}`" in found[f"configuration/{section}.md"]
            )
    assert (
        "| `turn_density` | number ≥ 0 | `0.005` | rad^2/s^3 | spectral density of the turn rate's changes |"
        in (found["configuration/tracking.md"])
    )
    assert "| `max_range_m` | number > 0 | `12.0` | m |" in found["configuration/sensors.md"]
    assert (
        "| `sensors.sonar.period_steps` | `5` | sensors `harsh`, sensors `nominal` |"
        in found["configuration/sensors.md"]
    )


@pytest.mark.parametrize(
    ("key", "told", "unit"),
    [
        ("gate_m", "", "m"),
        ("decay", "lambda", ""),
        ("speed_m_s", "", "m/s"),
        ("progress", "w_p [1/m]", "1/m"),
        ("schedule", "for example [[0, 1], [1, 0]]", ""),
        ("scenes", "(S, D, v [m/s]) dealt out", ""),
        ("hold_gain_n_m", "[N m/rad] roll and pitch", "N m/rad"),
    ],
)
def test_units_come_from_the_text_or_the_name(key, told, unit):
    assert configuration.unit_of(key, told) == unit


def test_what_a_help_text_says_is_no_markup():
    assert commands.words("a <b> `c <d>`\n```x\n<e>\n``` <f>") == "a \\<b> `c <d>`\n```x\n<e>\n``` \\<f>"


def test_every_stage_of_the_simulator_is_told():
    from uuvtai.stages import STAGES

    assert tuple(stages.FILES) == STAGES


def test_a_topic_without_its_rate_is_refused(monkeypatch):
    monkeypatch.delitem(topics.WHEN, "/tracks")
    with pytest.raises(ValueError, match="/tracks"):
        topics.page()


# ------------------------------------------------------------------------------------------------------ lines


def blocks(text):
    """(mark, lines) of every shell block; comments and continued lines as the shell sees them."""
    for fence in FENCE.finditer(text):
        if fence["language"] == "sh":
            yield (
                fence["mark"],
                [line for line in fence["body"].replace("\\\n", " ").splitlines() if line.strip()],
            )


def variants(usage):
    """Lines that a line of usage stands for: 'log info|export FILE [--out X]' is two."""
    words = [word.strip("[]") for word in usage.replace("\\|", "|").replace("...", "").split()]
    return [
        list(line) for line in itertools.product(*[word.split("|") for word in words if word.strip("[]")])
    ]


def fault(words, whole=True):
    """What is wrong with the words after ``uuv``; None = they can be parsed. In passing (not ``whole``)
    arguments may be missing."""
    command = commands.app()
    if {"--install-completion", "--show-completion"} & set(words):
        return None  # parsing them does what they say: the first writes into the reader's shell
    try:
        while hasattr(command, "commands") and words and not words[0].startswith("-"):
            name, words = words[0], words[1:]
            if name not in command.commands:
                return f"no command {name}"
            command = command.commands[name]
        command.make_context(
            "uuv", ["1" if word in NUMBERS else word for word in words] if not whole else list(words)
        )
    except Exception as error:
        cut = type(error).__name__ in (
            "MissingParameter",
            "NoArgsIsHelpError",
        ) or "requires an argument" in str(error)
        return None if cut and not whole else str(error)
    return None


@pytest.mark.parametrize("path", PROSE, ids=lambda path: path.stem)
def test_every_command_line_can_be_parsed(path):
    text = path.read_text()
    for _mark, lines in blocks(text):
        for line in lines:
            first, *words = shlex.split(line, comments=True) or [""]
            assert first != "uuv" or not fault(words), f"{path.name}: {line}: {fault(words)}"
    for usage in SPAN.findall(FENCE.sub("", text)):
        for _uuv, *words in variants(usage):
            assert not fault(words, whole=False), f"{path.name}: {usage}: {fault(words, whole=False)}"


def test_the_command_lines_are_found_and_a_wrong_one_is_seen():
    lines = [
        line
        for path in PROSE
        for _mark, found in blocks(path.read_text())
        for line in found
        if line.startswith("uuv ")
    ]
    assert len(lines) > 15
    assert "epsodes" in fault(["eval", "--epsodes", "3"])
    assert "no command" in fault(["evaluate"])
    assert "valid" in fault(["eval", "--episodes", "many"])
    assert fault(["simulate"]) and not fault(["simulate"], whole=False)
    assert variants("uuv log info\\|export FILE") == [
        ["uuv", "log", "info", "FILE"],
        ["uuv", "log", "export", "FILE"],
    ]


MARKED = [line for path in PROSE for mark, lines in blocks(path.read_text()) if mark for line in lines]
"""lines of blocks below ``<!-- run -->``"""


def test_lines_are_marked():
    assert {"uuv doctor", "uuv presets", "uuv tree"} <= set(MARKED)


@pytest.mark.parametrize("line", MARKED)
def test_marked_lines_run(line, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as left:
        main(shlex.split(line, comments=True)[1:])
    out, err = capfd.readouterr()
    assert left.value.code == 0, err
    assert out


# ------------------------------------------------------------------------------------------------------ links


@pytest.mark.parametrize("path", PROSE, ids=lambda path: path.stem)
def test_what_the_prose_points_to_is_there(path):
    text = FENCE.sub("", path.read_text())
    for target in PATH.findall(text):
        assert (ROOT / target).exists() or target.startswith("docs/reference/"), f"{path.name} names {target}"
    for target in LINK.findall(text):
        assert (path.parent / target).exists() or target.startswith("reference/"), (
            f"{path.name} links {target}"
        )


@pytest.mark.parametrize("path", PROSE, ids=lambda path: path.stem)
def test_external_addresses_are_well_formed(path):
    """Nothing is fetched: tests have no network."""
    for address in ADDRESS.findall(path.read_text()):
        parts = urlsplit(address.rstrip(".,;:"))
        assert parts.scheme in ("http", "https") and re.fullmatch(
            r"[\w-]+(\.[\w-]+)+(:\d+)?", parts.netloc
        ), f"{path.name}: {address}"


# --------------------------------------------------------------------------------------------------- notebook


def test_the_tutorial_runs():
    """In a process of its own, whose simulator has the sizes of the small one: ``tests/warm.py`` has compiled
    its kernels."""
    nbformat = pytest.importorskip("nbformat", reason="nbclient is not installed")
    client = pytest.importorskip("nbclient", reason="nbclient is not installed")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.outputs for cell in notebook.cells if cell.cell_type == "code"), (
        "commit it without outputs"
    )
    client.NotebookClient(notebook, timeout=600, startup_timeout=300, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    printed = "".join(output.get("text", "") for output in outputs)
    assert "sector_range" in printed and re.search(r"success [0-8]/8, 95 % interval", printed)
