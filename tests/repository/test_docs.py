"""The documentation: builds without a warning, no page missing, what readers type works, the tutorial."""

import ast
import contextlib
import importlib
import itertools
import multiprocessing
import os
import re
import shlex
import shutil
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from PIL import Image

from docs.writers import commands, configuration, stages, topics
from docs.writers.markdown import FENCE, shell_blocks
from tests.browser import brightness, look
from tests.command import uuv
from uuvtai.config.learning import LearningConfig
from uuvtai.envs.vector_env import VectorEnv
from uuvtai.logs.topics import TOPICS
from uuvtai.sim.stages import STAGES

ROOT = Path(__file__).parents[2]
PROSE = sorted(
    [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").glob("*.md"),
        ROOT / "benchmarks/README.md",
        ROOT / "runs/README.md",
    ]
)
NOTEBOOK = ROOT / "examples/tutorial.ipynb"

SPAN = re.compile(r"`(uuv [^`]+)`")
PATH = re.compile(r"`((?:docs|examples|tests|uuvtai|benchmarks)/[\w./-]+\.\w+)`")
ADDRESS = re.compile(r"https?://[^\s<>)\]`\"']+")
LINK = re.compile(r"(?<!`)\[[^\]]*\]\((?!https?:)([^)#\s]+)")
NUMBERS = {"N", "K", "S"}
"""what stands for a number in a line of usage"""


# ------------------------------------------------------------------------------------------------------- site


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site's folder. Broken internal links are warnings of Sphinx, and warnings are errors here. Built by
    a fork of this process, which has imported what the pages are of."""
    pytest.importorskip("myst_parser", reason="the extra docs is not installed")
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(ROOT / "docs", folder / "docs", ignore=shutil.ignore_patterns("reference", "__pycache__"))
    builder = multiprocessing.get_context("fork").Process(target=built_in, args=(folder,))
    builder.start()
    builder.join()
    assert builder.exitcode == 0, (folder / "told").read_text()
    return folder / "site"


def built_in(folder):
    """Build ``docs`` there, as ``bootstrap.py docs`` does; what is wrong goes into a file."""
    from sphinx.cmd import build

    os.chdir(folder)
    with open("told", "w") as told, contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
        code = build.main(["-W", "--keep-going", "-q", "docs", "site"])
    sys.exit(code)


def test_the_site_builds_without_a_warning_and_lacks_no_page(site):
    built = {str(page.relative_to(site).with_suffix("")) for page in site.rglob("*.html")}
    assert {f"reference/commands/{name}" for name in commands.app().commands} <= built
    assert {f"reference/configuration/{name}" for name in LearningConfig.model_fields} <= built
    assert {path.stem for path in (ROOT / "docs").glob("*.md")} <= built
    of_eval = (site / "reference/commands/eval.html").read_text()
    assert "[default: runs/TIME_PRESET]" in of_eval and "With --explain:" in of_eval, (
        "help texts are shown as they are"
    )
    assert "overflow-x: auto" in (site / "_static/custom.css").read_text() and "custom.css" in of_eval
    assert "search" in built and "gauntlet" in (site / "searchindex.js").read_text()


def test_the_page_of_the_python_api_has_what_programs_use(site):
    page = (site / "extend.html").read_text() + (site / "logs.html").read_text()
    for name in (
        "uuvtai.make", "uuvtai.api.Log.messages",
        "uuvtai.envs.vector_env.VectorEnv.step", "uuvtai.envs.gymnasium.UuvVectorEnv.step",
        "uuvtai.envs.gymnasium.UuvEnv.step", "uuvtai.learning.policy_agent.PolicyAgent.act",
        "uuvtai.learning.export.run_policy.Policy.act", "uuvtai.logs.reader.read_messages",
    ):  # fmt: skip
        described = page.partition(f'id="{name}"')[2].partition('id="uuvtai.')[0]
        assert "<p>" in described, f"{name} has no text"


def test_the_site_is_whole_and_quiet_on_every_screen(site):
    pages = [site / f"{name}.html" for name in ("index", "evaluate", "extend", "reference/commands/eval")]
    seen = look(*pages)
    for view, found in seen.items():
        shown = found["closed"]
        assert shown["scrollWidth"] <= shown["innerWidth"], f"{view} overflows"
        assert found["errors"] == [] and shown["deadLinks"] == 0, view
        assert all(request.startswith(site.as_uri()) for request in found["requests"]), view
    gallery = str(pages[1])
    assert seen[gallery, 390, "light"]["open"]["images"] == (ROOT / "docs/evaluate.md").read_text().count(
        "!["
    )
    light, dark = (seen[gallery, 390, scheme]["closed"] for scheme in ("light", "dark"))
    assert brightness(light["background"]) > 700 and brightness(dark["background"]) < 100
    assert brightness(light["ink"]) < 100 and brightness(dark["ink"]) > 500


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
    presets = "sensors `harsh`, sensors `multibeam_image`, sensors `nominal`"
    assert f"| `sensors.sonar.period_steps` | `5` | {presets} |" in found["configuration/sensors.md"]


@pytest.mark.parametrize(
    ("key", "answer", "unit"),
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
def test_units_come_from_the_text_or_the_name(key, answer, unit):
    assert configuration.unit_of(key, answer) == unit


def test_what_a_help_text_says_is_no_markup():
    assert commands.words("a <b> `c <d>`\n```x\n<e>\n``` <f>") == "a \\<b> `c <d>`\n```x\n<e>\n``` \\<f>"


def test_every_stage_of_the_simulator_is_told():
    assert tuple(stages.FILES) == STAGES


def test_every_topic_of_a_log_is_on_its_page():
    page = topics.page()
    assert len(TOPICS) >= 24
    for topic in TOPICS:
        assert f"| `{topic.name}` |" in page and topic.when.text + topic.note in page
    assert "| `/tracks` | uuv.Tracks | every new scan |" in page and "`/tracks`. Moving obstacles" in page


# ------------------------------------------------------------------------------------------------------ lines


def variants(usage):
    """Lines that a line of usage stands for: 'log info|export FILE [--out X]' is two."""
    words = [word.strip("[]") for word in usage.replace("\\|", "|").replace("...", "").split()]
    return [
        list(line) for line in itertools.product(*[word.split("|") for word in words if word.strip("[]")])
    ]


def fault(words, whole=True):
    """What is wrong with the words after ``uuv``, or None. In passing (not ``whole``) arguments may miss."""
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
    for _mark, lines in shell_blocks(text):
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
        for _mark, found in shell_blocks(path.read_text())
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


MARKED = [line for path in PROSE for mark, lines in shell_blocks(path.read_text()) if mark for line in lines]
"""lines of blocks below ``<!-- run -->``"""


def test_lines_are_marked():
    assert {"uuv doctor", "uuv presets", "uuv presets show bt"} <= set(MARKED)


@pytest.mark.parametrize("line", MARKED)
def test_marked_lines_run(line, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    code, out, err = uuv(capfd, *shlex.split(line, comments=True)[1:])
    assert code == 0, err
    assert out


# ---------------------------------------------------------------------------------------------------- gallery


GALLERY = (ROOT / "docs/evaluate.md").read_text().partition("## Gallery")[2]
TUNING = ("77", "77001")
"""seeds that pictures may be of"""


def test_every_picture_of_the_gallery_has_its_command_and_is_small():
    lines = [shlex.split(line) for _mark, lines in shell_blocks(GALLERY) for line in lines]
    made = [words[words.index("--out") + 1] for words in lines if "--out" in words]
    there = {
        path.relative_to(ROOT).as_posix(): path.stat().st_size for path in (ROOT / "docs/gallery").iterdir()
    }
    assert sorted(made) == sorted(there)
    assert {f"docs/{target}" for target in LINK.findall(GALLERY)} >= set(there), "all are shown"
    assert max(there.values()) <= 1e6 and sum(there.values()) <= 3e6
    evals = [words for words in lines if words[1] == "eval"]
    assert len(evals) > 3 and all(words[words.index("--seeds") + 1] in TUNING for words in evals)


def test_the_gifs_are_those_of_their_commands():
    for _mark, lines in shell_blocks(GALLERY):
        for words in (shlex.split(line) for line in lines if ".gif" in line):
            first = words.index("--speed" if words[1] == "log" else "--episode")
            chosen = {"--width": 640, **dict(zip(words[first::2], words[first + 1 :: 2], strict=True))}
            with Image.open(ROOT / chosen["--out"]) as gif:
                assert gif.width == int(chosen["--width"]) and gif.n_frames > 10
                assert gif.info["duration"] == pytest.approx(1000 / int(chosen["--fps"]), abs=10)


# ------------------------------------------------------------------------------------------------------ width

ONE_PIECE = re.compile(r"\s*[(]?(`[^`]*`|\[[^\]]*\]\(\S*\))\W?")
"""a line that cannot be broken: one command, one link"""


WRAPPED = [path for path in PROSE if path.name != "results.md"]
"""pages that no script writes"""


@pytest.mark.parametrize("path", WRAPPED, ids=lambda path: path.stem)
def test_no_line_is_longer_than_140_characters(path):
    """Rows of tables cannot be wrapped."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith(("|", "!["))]
    assert [line for line in lines if len(line) > 140 and not ONE_PIECE.fullmatch(line)] == []


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


# ----------------------------------------------------------------------------------------------------- Python


def snippets():
    """(page, code) of every Python block."""
    for path in PROSE:
        for fence in FENCE.finditer(path.read_text()):
            if fence["language"] == "python":
                yield path.name, fence["body"]


@pytest.mark.parametrize(("page", "code"), snippets())
def test_what_a_snippet_imports_of_ours_is_there(page, code):
    for node in ast.walk(ast.parse(code, page)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("uuvtai"):
            found = importlib.import_module(str(node.module))
            missing = [name.name for name in node.names if not hasattr(found, name.name)]
            assert missing == [], f"{page}: {node.module} has no {missing}"


def test_the_tables_of_the_python_page_are_those_of_the_environment(small):
    """Every tensor with its shape and type; N, M, K as the page names them."""
    small.sim.use_tree(small.trees["bt"])
    with VectorEnv(small.sim) as env:
        obs, info = env.reset()
        action = info["teacher_action"]
        obs, reward, terminated, truncated, info = env.step(action)
        sizes = {"N": env.num_envs, "M": env.num_obs, "K": len(env.reward_terms), "4": env.num_actions}
    named = {"action": action, "obs": obs, "reward": reward, "terminated": terminated, "truncated": truncated}
    wanted = named | {f'info["{name}"]': value for name, value in info.items()}
    rows = re.findall(
        r"^\| `([^`]+)` \| \(([^)]*)\) \| (\w+) \|", (ROOT / "docs/extend.md").read_text(), re.M
    )
    answer = {name: (tuple(sizes[n] for n in re.findall(r"\w+", shape)), kind) for name, shape, kind in rows}
    assert answer == {
        name: (tuple(value.shape), str(value.dtype).removeprefix("torch.")) for name, value in wanted.items()
    }


# --------------------------------------------------------------------------------------------------- notebook


def test_the_tutorial_runs(tmp_path):
    """In a process of its own with the small simulator's sizes (compiled by ``tests/warm.py``)."""
    nbformat = pytest.importorskip("nbformat", reason="nbclient is not installed")
    client = pytest.importorskip("nbclient", reason="nbclient is not installed")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.outputs for cell in notebook.cells if cell.cell_type == "code"), (
        "commit it without outputs"
    )
    place = {"metadata": {"path": str(tmp_path)}}
    client.NotebookClient(
        notebook, timeout=600, startup_timeout=300, kernel_name="python3", resources=place
    ).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    assert any("<td>planner</td>" in output.get("data", {}).get("text/html", "") for output in outputs)
    printed = "".join(output.get("text", "") for output in outputs)
    assert "sector_range" in printed and "replans an episode: [" in printed
