"""The kit for a paper: vector figures of set widths, tables that LaTeX takes, captions that say n."""

import csv
import json
import re
import shutil
import subprocess
from xml.etree import ElementTree

import pytest

from tests import report_samples as samples
from tests.command import uuv
from tests.logs.test_pictures import N_STEP
from tests.oracles import logs as episode
from uuvtai.common.errors import UserError
from uuvtai.common.statistics import holm_adjusted
from uuvtai.config.loader import ConfigError
from uuvtai.evaluation.results import paired
from uuvtai.logs.encode import LogError
from uuvtai.logs.run_folder import RunFolderError
from uuvtai.report import paper as latex
from uuvtai.report import paper as paper_kit
from uuvtai.report.paper import items_of, paper
from uuvtai.report.paper_style import sheets
from uuvtai.report.tables import Table, heads

EVIL = "a_b&c%d#e$f{g}h~i^j\\input{/etc/passwd}|<k>\n\x1b[2J"
POINTS = 72.0
"""of an inch"""


def evaluated(folder, *agents, **more):
    """A run folder of an evaluation."""
    document = samples.evaluation_document(*agents)
    document["paired"] = paired(document["agents"])
    return samples.write_run(folder, ("uuv", "eval", "--set", EVIL), eval__result=document, **more)


def text_of(path):
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def kit(tmp_path_factory):
    """The kit of an evaluation, a sweep and two trainings of one agent."""
    place = tmp_path_factory.mktemp("runs")
    small = samples.sweep_document("bt", {"S": [8], "D": [0, 6], "v_m_s": [0.4, 0.6]})
    kept = ("iteration", "time/env_steps", "rollout/ep_rew_mean")
    metrics = [{key: row[key] for key in kept} for row in samples.metrics()]
    train = ("uuv", "train", "smoke")
    runs = [
        evaluated(place / "first", samples.agent("straight", 3, 5), samples.agent(EVIL, 7, 1)),
        samples.write_run(place / "grid", ("uuv", "sweep"), sweep=small),
        *(
            samples.write_run(place / f"run_{seed}", train, f"train: {{seed: {seed}}}\n", metrics=metrics)
            for seed in (1, 2)
        ),
    ]
    return paper(runs, place / "kit")


# ------------------------------------------------------------ figures


def test_figures_are_as_wide_as_the_columns(kit):
    names = {path.name for path in kit.figures}
    assert {"first_agents_1col.pdf", "first_agents_2col.svg", "grid_heat_map_bt_1col.svg"} <= names
    assert "run_1_training_2col.pdf" in names
    for path in kit.figures:
        if path.suffix == ".svg":
            width = ElementTree.fromstring(path.read_bytes()).get("width")
            inches = float(width.removesuffix("pt")) / POINTS
            assert inches == pytest.approx(3.5 if path.stem.endswith("1col") else 7.16)
        else:
            assert path.read_bytes().startswith(b"%PDF-")


def test_text_is_of_one_size_and_a_font_that_publishers_take(kit):
    content = next(path for path in kit.figures if path.name == "first_agents_1col.pdf").read_bytes()
    assert b"/Type3" not in content and b"STIXGeneral" in content


def test_the_same_runs_give_the_same_files(kit, tmp_path):
    again = paper([kit.folder.parent / "first"], tmp_path / "kit")
    assert len(again.figures) == 4
    for path in again.figures:
        assert path.read_bytes() == (kit.folder / f"figures/first_{path.name}").read_bytes()


def test_the_numbers_of_every_figure_lie_beside_it(kit):
    rows = list(csv.DictReader(text_of(kit.folder / "data/grid_heat_map_bt.csv").splitlines()))
    assert len(rows) == 3 and {row["episodes"] for row in rows} == {"16"}


# ------------------------------------------------------------ tables


def test_the_table_of_methods_has_n_and_intervals(kit):
    answer = text_of(kit.folder / "tables/first_agents.tex")
    assert r"straight & 8 & 37.5 [13.7, 69.4] & 62.5 [30.6, 86.3] & 0 & " in answer
    assert all(
        rule in answer for rule in (r"\toprule", r"\midrule", r"\bottomrule", r"\begin{tabular}{lrrrrr}")
    )


def test_a_grid_says_where_a_row_does_not_depend_on_the_column(kit):
    answer = text_of(kit.folder / "tables/grid_grid_bt.tex")
    assert r"8 \textperiodcentered{} 0 & 100.0 / 0.0 &  \\" in answer
    assert "A row with one entry does not depend on v m/s." in answer


def test_causes_of_failures_are_a_table(tmp_path):
    run = evaluated(tmp_path / "run", samples.agent("bt", causes=[samples.CAUSE], explain=[{}, {}]))
    (item,) = [item for item in items_of(run) if item.name == "causes_bt"]
    assert "n = 2 failures of 8 episodes" in item.caption
    assert "undetected above & 2 & 100" in latex.tabular(item.table, "")


def test_one_axis_makes_a_row_a_cell(tmp_path):
    for name, document in (("noise", samples.noise_sweep()), ("alone", samples.robustness_sweep())):
        run = samples.write_run(tmp_path / name, ("uuv", "sweep"), sweep=document)
        (table,) = [item.table for item in items_of(run) if item.table is not None]
        assert len(table.rows) == len(document["cells"])


# ------------------------------------------------------------ captions


def test_every_caption_says_n_the_command_and_the_commit(kit):
    answer = text_of(kit.folder / "captions.md")
    parts = answer.split("\n## ")[1:]
    assert len(parts) >= 7
    for part in parts:
        assert re.search(r"n = \d+", part), part
        assert "interval" in part, part
        assert "    command: uuv " in part and "    commit: abc (uuvtai 0.1.0)" in part
    tex = text_of(kit.folder / "captions.tex")
    assert tex.count(r"\caption{") == len(parts) == tex.count(r"\label{")


def test_what_a_user_names_is_text_and_no_command(kit):
    for path in kit.folder.rglob("*.tex"):
        plain = "\n".join(line for line in text_of(path).splitlines() if not line.startswith("%"))
        assert "/etc/passwd" not in plain or r"\textbackslash{}input\{/etc/passwd\}" in plain
        assert r"\input{/etc" not in plain and "\x1b" not in text_of(path)
    assert not list(kit.folder.rglob("*[!A-Za-z0-9_.]*"))
    markdown = text_of(kit.folder / "captions.md")
    assert "\x1b" not in markdown and "<k>" not in re.sub(r"^    .*$", "", markdown, flags=re.M)
    rows = list(csv.reader(text_of(kit.folder / "tables/first_agents.csv").splitlines()))
    assert len(rows) >= 3


@pytest.mark.parametrize(
    ("text", "answer"),
    [
        ("--grid a,,b", "-{}-grid a,{},b"),
        ("50 % & more_", r"50 \% \& more\_"),
        ("Zoë · 速", r"Zoë \textperiodcentered{} ?"),
        ("two\nlines\tof", "two lines of"),
        ("``x''", r"\textasciigrave{}\textasciigrave{}x\textquotesingle{}\textquotesingle{}"),
    ],
)
def test_characters_as_latex_wants_them(text, answer):
    assert latex.escaped(text) == answer


def test_a_cell_that_begins_like_an_argument_is_none():
    answer = latex.tabular(Table(heads("a", "b"), [["[0.1, 0.2]", "*"]]), "from\n%x\n\\y")
    assert r"{[}0.1, 0.2] & {*} \\" in answer
    assert all(line.startswith("%") for line in answer.splitlines()[:3])


@pytest.mark.parametrize(
    ("value", "answer"),
    [
        ("=cmd()", "'=cmd()"),
        ("@x", "'@x"),
        ("-0.5", "-0.5"),
        ("-", "-"),
        (-0.5, -0.5),
        ("-x", "'-x"),
        (None, None),
    ],
)
def test_no_text_in_a_csv_is_a_formula(value, answer):
    assert paper_kit._harmless(value) == answer


# ------------------------------------------------------------ the folder


def test_logs_make_a_figure_of_the_ways(tmp_path):
    run = evaluated(tmp_path / "run")
    (run / "logs").mkdir()
    episode.record(run / "logs/bt_seed0_episode3.mcap", N_STEP)
    straight = run / "logs/straight_seed0_episode3.mcap"
    episode.record(straight, N_STEP, episode.header("straight"), "collision", sway=-0.9)
    (item,) = [item for item in items_of(run) if item.name.startswith("ways")]
    assert item.name == "ways_seed0_episode3" and "n = 1 episode; no intervals." in item.caption
    assert "bt: success after" in item.caption and "straight: collision after" in item.caption
    assert len(sheets(item.panels, 3.5)["pdf"]) > 4000
    episode.record(run / "logs/planner_seed0_episode3.mcap", N_STEP, episode.header("planner", 4))
    with pytest.raises(LogError, match="is another episode"):
        items_of(run)


def test_only_a_new_or_empty_folder_is_written(tmp_path, capfd):
    run = evaluated(tmp_path / "run")
    full = tmp_path / "full"
    full.mkdir()
    (full / "mine.txt").write_text("mine")
    with pytest.raises(RunFolderError, match="is not empty; give --paper a new folder"):
        paper([run], full)
    with pytest.raises(RunFolderError, match="is no folder"):
        paper([run], full / "mine.txt")
    (tmp_path / "link").symlink_to(tmp_path / "else")
    with pytest.raises(RunFolderError, match="is no folder"):
        paper([run], tmp_path / "link")
    assert [path.name for path in full.iterdir()] == ["mine.txt"]
    for more in (["--force"], ["--out", "x.html"]):
        code, _out, err = uuv(capfd, "report", run, "--paper", tmp_path / "kit", *more)
        assert code == 2 and "leave out --out, --open and --force" in " ".join(err.split())
    assert not (tmp_path / "kit").exists()


def test_runs_without_anything_to_show_are_refused_and_nothing_is_written(tmp_path):
    bare = samples.write_run(tmp_path / "bare")
    damaged = samples.write_run(tmp_path / "damaged", eval__result={"schema": 1, "agents": [{"name": 1}]})
    whole = samples.write_run(tmp_path / "whole", reproduce={"title": "x"})
    for run, says in (
        (bare, "has nothing to report"),
        (damaged, "not as this version writes"),
        (whole, "one by one"),
    ):
        with pytest.raises(ConfigError, match=says):
            paper([run], tmp_path / "kit")
    with pytest.raises(UserError):
        paper([tmp_path / "nowhere"], tmp_path / "kit")
    assert not (tmp_path / "kit").exists()


def test_the_command_names_the_folder_and_adjusts_the_paired_test(tmp_path, capfd):
    run = evaluated(
        tmp_path / "run", samples.agent("a", 1, 7), samples.agent("b", 8, 0), samples.agent("c", 7, 1)
    )
    code, out, _err = uuv(capfd, "report", run, "--paper", tmp_path / "kit", "--json")
    found = json.loads(out)
    assert code == 0 and found["paper"] == str(tmp_path / "kit")
    assert len(found["figures"]) == 4 and len(found["tables"]) == 4
    assert (tmp_path / "kit/paper.tex").exists()
    rows = list(csv.DictReader(text_of(tmp_path / "kit/tables/paired.csv").splitlines()))
    plain = [float(row["mcnemar_p"]) for row in rows]
    assert [float(row["holm_p"]) for row in rows] == pytest.approx(holm_adjusted(plain))
    assert plain != [float(row["holm_p"]) for row in rows]
    assert "adjusted by Holm (tests: 3)" in text_of(tmp_path / "kit/captions.md")


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs TeX")
def test_latex_takes_it(kit):
    done = subprocess.run(
        ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"], cwd=kit.folder,
        capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:].decode(errors="replace")
