"""The report: layout of heat maps, colours of figures, a page that says everything and trusts nothing."""

import csv
import hashlib
import io
import json
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from importlib.resources import files
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests import report_samples as samples
from uuvtai.common.colours import PALETTE, agent_colours, contrast, ink_on, shade
from uuvtai.common.errors import UserError
from uuvtai.config.loader import ConfigError
from uuvtai.evaluation.results import paired
from uuvtai.logs.run_folder import RunFolderError
from uuvtai.report import build, recorded
from uuvtai.report import figures as ink
from uuvtai.report.blocks import Figure
from uuvtai.report.build import media, report
from uuvtai.report.evaluation import evaluation, paired_table
from uuvtai.report.figures import Line, curves, heat_map, intervals
from uuvtai.report.html import Page, render
from uuvtai.report.sweep import grid_table, sweep
from uuvtai.report.tables import PAGE, Data, Table, pivot
from uuvtai.report.timing import timing
from uuvtai.report.training import Training, grouped, training

EVALUATED = samples.evaluation_document()
READABLE = 4.5
"""contrast of small text, WCAG 2.2 level AA"""

# ----------------------------------------------------------------------------------------- colours and layout


@given(st.floats(0, 1, allow_subnormal=False))  # kernels that ran before switch them off
def test_text_stands_out_from_every_shade(share):
    assert contrast(ink_on(shade(share)), shade(share)) >= READABLE


def test_more_is_brighter_all_along():
    against_black = [contrast(shade(i / 50), "#000000") for i in range(51)]
    assert against_black == sorted(against_black)
    assert (shade(-1), shade(2)) == ("#440154", "#fde725")


def test_contrast_as_the_standard_computes_it():
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.01)


def test_the_papers_grid_has_a_row_for_every_s_and_d_and_no_speed_without_motion():
    document = samples.sweep_document()
    grid = pivot(document["cells"], document["axes"])
    assert (grid.row_axes, grid.column_axis) == (("S", "D"), "v_m_s")
    assert grid.row_names[:6] == ["4 · 0", "4 · 3", "4 · 6", "4 · 9", "4 · 15", "8 · 0"]
    assert grid.column_names == ["0.2", "0.4", "0.6", "0.8", "1.5", "3"]
    still = [place for place in grid.places if place.cell["D"] == 0]
    assert [(place.row, place.first, place.n_columns) for place in still] == [
        (0, 0, 6),
        (5, 0, 6),
        (10, 0, 6),
    ]
    fast = next(
        place
        for place in grid.places
        if (place.cell["S"], place.cell["D"], place.cell["v_m_s"]) == (8, 6, 3.0)
    )
    assert (fast.row, fast.first, fast.n_columns) == (7, 5, 1)


def test_values_of_an_axis_may_be_lists():
    axes = {"disturbance.current_m_s": [[0.0, 0.1, 0.0], [0.0, 0.2, 0.0]], "D": [3, 6]}
    cells = [
        {"disturbance.current_m_s": list(c), "D": d, "episodes": 4}
        for c in ((0.0, 0.2, 0.0), (0.0, 0.1, 0.0))
        for d in (3, 6)
    ]
    grid = pivot(cells, axes)
    assert grid.row_names == ["[0.0, 0.1, 0.0]", "[0.0, 0.2, 0.0]"] and grid.column_names == ["3", "6"]


def test_a_grid_that_cannot_be_laid_out_says_why():
    document = samples.sweep_document()
    with pytest.raises(ValueError, match="same place"):
        pivot(document["cells"] * 2, document["axes"])
    with pytest.raises(ValueError, match="not among the axis' values"):
        pivot([{"S": 4, "D": 3, "v_m_s": 9.9}], document["axes"])


def test_a_cell_without_episodes_is_a_dash():
    document = samples.sweep_document(axes={"S": [4], "D": [3], "v_m_s": [0.2, 0.4]})
    document["cells"][0] |= {
        "success_rate": None, "collision_rate": None, "success_ci95": None, "time_to_success_mean_s": None,
    }  # fmt: skip
    table, _note = grid_table(document["cells"], document)
    assert str(table.rows[0][1]) == "- / -"
    hover = drawn(heat_map(pivot(document["cells"], document["axes"]), "success_rate", "x"))[1]
    assert hover["cell-0"] == "S = 4, D = 3, v m/s = 0.2\ncollision -\nmean time to success - s".replace(
        "\ncollision -", ""
    )


def test_nothing_draws_that_only_prints():
    heavy = ("matplotlib", "jinja2", "torch", "taichi")
    code = (
        f"import sys, uuvtai.console.screen, uuvtai.report.build; print([m for m in {heavy} if m in "
        "sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# ---------------------------------------------------------------------------------------------------- figures


def drawn(panel, prefix="f-"):
    """(root of the SVG, hover texts by id without the prefix)."""
    root = ElementTree.fromstring(ink.svg(panel, prefix, "what it shows"))
    titles = {
        e.get("id").removeprefix(prefix): t.text
        for e in root.iter()
        for t in e
        if t.tag.endswith("}title") and e.get("id")
    }
    return root, titles


def words(root):
    """Every line of text, in the order of the drawing: ticks across, ticks up, then titles."""
    return [e.text for e in root.iter() if e.tag.endswith("}text") and e.text and e.text.strip()]


def test_figures_take_the_colours_of_the_page():
    root, _ = drawn(curves([Line("a", [0, 1], [1, 2]), Line("b", [0, 1], [2, 1])], "title", "x"))
    text = ElementTree.tostring(root, encoding="unicode")
    assert ink.INK not in text
    assert "currentColor" in text and "var(--series-0" in text and "var(--series-1" in text
    assert not [e for e in root.iter() if e.tag.endswith(("}style", "}metadata", "}script"))]
    assert all("currentColor" in e.get("style") for e in root.iter() if e.tag.endswith("}text"))


def test_ids_of_two_figures_never_meet_and_every_reference_is_kept():
    panel = curves([Line("a", [0, 1], [1, 2], [0, 1], [2, 3])], "t", "x")
    ids = []
    for prefix in ("one-", "two-"):
        text = ink.svg(panel, prefix, "")
        own = re.findall(r' id="([^"]*)"', text)
        used = re.findall(r'href="#([^"]*)"', text) + re.findall(r"url\(#([^)]*)\)", text)
        assert used and set(used) <= set(own)
        ids += own
    assert len(ids) == len(set(ids))


def test_every_cell_tells_its_count_and_interval_on_hover():
    document = samples.sweep_document()
    root, hover = drawn(heat_map(pivot(document["cells"], document["axes"]), "success_rate", "bt"))
    assert len(hover) == len(document["cells"]) == 75
    corner = next(text for text in hover.values() if text.startswith("S = 12, D = 15, v m/s = 3\n"))
    assert corner.splitlines()[1:] == [
        "success 1/16 = 6.2 % [1.1, 28.3]", "collision 7/16 = 43.8 % [23.1, 66.8]", "mean time to success "
                                                                                    "9.5 s",
    ]  # fmt: skip
    shown = [e.text for e in root.iter() if e.tag.endswith("}text")]
    assert {"6 %", "9.5 s", "100 %", "S · D", "v m/s"} <= set(shown)


def test_names_are_drawn_as_they_are():
    root, _ = drawn(
        curves([Line("$x^2$", [0, 1], [1, 2]), Line("</svg><script>", [0, 1], [1, 2])], "\\alpha & <b>", "x")
    )
    texts = {e.text for e in root.iter() if e.tag.endswith("}text")}
    assert {"$x^2$", "</svg><script>", "\\alpha & <b>"} <= texts


def test_a_figure_on_disk_is_a_picture_with_both_panels():
    import cv2

    document = samples.sweep_document(axes={"S": [4, 8], "D": [3], "v_m_s": [0.2, 3.0]})
    grid = pivot(document["cells"], document["axes"])
    one, two = (
        ink.png([heat_map(grid, key, "t") for key in keys])
        for keys in (["success_rate"], ["collision_rate", "success_rate"])
    )
    sizes = [cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR).shape for content in (one, two)]
    assert sizes[1][1] == pytest.approx(2 * sizes[0][1], abs=2)
    assert sizes[1][0] == sizes[0][0]


# ----------------------------------------------------------------------------------------------------- blocks


def tables(blocks):
    return [block for block in blocks if isinstance(block, Table)]


def rows(table):
    """Texts of a table's cells as the page has them."""
    return [[str(cell) for cell in row] for row in table.on(PAGE)[1]]


def figures(blocks):
    return {block.name: block for block in blocks if isinstance(block, Figure)}


def test_methods_are_shown_with_counts_intervals_and_both_times():
    first = tables(evaluation(samples.evaluation_document()))[0]
    assert rows(first)[1] == [
        "bt", "6/8 = 75.0 % [40.9, 92.9]", "2/8 = 25.0 % [7.1, 59.1]", "2 / 0 / 0 / 0", "12.0", "16.0",
        "3.0", "0.30",
    ]  # fmt: skip
    assert first.data.columns[:3] == ["agent", "episodes", "success"]
    assert first.data.rows[1][:3] == ["bt", 8, 6]


def test_a_method_without_episodes_is_dashes():
    nobody = (
        samples.agent("bt")
        | samples.rates(0, 0, 1)
        | {"episodes": 0, "success_rate": None, "success_ci95": None}
    )
    nobody |= {"collision_rate": None, "collision_ci95": None}
    row = rows(tables(evaluation(samples.evaluation_document(nobody)))[0])[0]
    assert row[1:3] == ["-", "-"]


def test_causes_are_shown_where_there_are_any():
    blocks = evaluation(
        samples.evaluation_document(samples.agent("best", causes=[samples.CAUSE], explain=[1, 2]))
    )
    assert rows(tables(blocks)[-1]) == [
        ["undetected above", "2", "100 %", "50 %", "1.7", "-", "0.2", samples.CAUSE["meaning"]]
    ]


def test_a_sweep_over_two_axes_is_two_heat_maps_a_method():
    document = samples.sweep_document()
    document["cells"] += samples.sweep_document("best")["cells"]
    found = figures(sweep(document))
    assert [(name, len(figure.panels)) for name, figure in found.items()] == [
        ("heat_map_bt", 2),
        ("heat_map_best", 2),
    ]
    assert len(found["heat_map_bt"].data.rows) == 75


def test_a_sweep_over_one_axis_is_curves_with_intervals():
    blocks = sweep(samples.noise_sweep())
    hover = drawn(figures(blocks)["sweep_sensors"].panels[0])[1]
    assert hover["interval-1-3"].splitlines()[:2] == [
        "best, sensors = harsh",
        "success 12/16 = 75.0 % [50.5, 89.8]",
    ]
    assert rows(tables(blocks)[0])[0][:3] == ["bt", "clean", "16/16 = 100.0 % [80.6, 100.0]"]


def test_a_sweep_of_one_axis_at_a_time_is_a_figure_an_axis_around_what_is_unchanged():
    blocks = sweep(samples.robustness_sweep())
    found = figures(blocks)
    assert {
        name: [row[0:4] for row in figure.data.rows if row[0] == "bt"] for name, figure in found.items()
    } == {
        "sweep_D": [["bt", 8, 6, 0.6], ["bt", 8, 9, 0.6]],
        "sweep_disturbance.current_m_s": [["bt", 8, 6, 0.6], ["bt", 8, 6, 0.6]],
        "sweep_sensors": [["bt", 8, 6, 0.6]] * 3,
    }
    root, hover = drawn(found["sweep_sensors"].panels[1])
    assert words(root)[:3] == ["unchanged", "clean", "harsh"]
    assert hover["interval-1-2"].splitlines()[0] == "best, S = 8, D = 6, v m/s = 0.6, sensors = harsh"
    root, hover = drawn(found["sweep_disturbance.current_m_s"].panels[0])
    assert words(root)[:3] == ["[0.0, 0.0, 0.0]", "(own)", "[0.0, 0.2, 0.0]"]
    assert "disturbance.current_m_s = [0.0, 0.2, 0.0]" in hover["interval-0-1"]
    assert len(rows(tables(blocks)[0])) == 10


def test_an_axis_of_shares_ends_where_the_intervals_do():
    line = Line("bt", [0], [0.02], [0.01], [0.19], ["said"])
    assert words(drawn(intervals([line], ["here"], "collision", "x"))[0])[-3] == "20.0"
    assert words(drawn(intervals([replace(line, high=[0.51])], ["here"], "collision", "x"))[0])[-3] == "100"


def test_an_unfinished_sweep_says_so():
    assert "No cell" in sweep({"cells": [], "axes": {"S": [4]}})[0].text


def test_a_profile_shows_rates_stages_and_the_papers_tables():
    blocks = timing(samples.PROFILE)
    rates, latency, density = map(rows, tables(blocks))
    assert rates[1] == ["1,024", "bt", "8", "6", "92,160", "81,920", "-", "307.2", "20.0"]
    assert latency == [["Full loop", "3.100", "9.000", "28.630", "39.880"]]
    assert density[2] == ["15", "3.50", "35.0", "20.0", "50.0"]
    stages = figures(blocks)["stages"]
    assert len(stages.data.rows) == 2 * len(samples.STAGES)
    assert drawn(stages.panels[1])[1]["stage-0-9"] == "export: 10.00 us per env-step, 18.2 %"


def seeds_of(name, offsets, n=30, config="train:\n  seed: {}\n"):
    return [
        Training(f"{name}_{i}", config.format(i), samples.metrics(n + i, offset))
        for i, offset in enumerate(offsets)
    ]


def test_seeds_of_a_method_are_its_mean_and_its_range():
    blocks = training(seeds_of("ppo", (0.0, 3.0, 6.0)))
    rows = [row for row in figures(blocks)["training"].data.rows if row[1] == "rollout/ep_rew_mean"]
    assert len(rows) == 30, "only iterations that every seed has"
    assert rows[9] == ["ppo (3 seeds)", "rollout/ep_rew_mean", 0.01, -17.0, -20.0, -14.0]


def test_only_the_seed_makes_no_other_method():
    other = Training("constant_20_0", "train:\n  seed: 0\n  iterations: 9\n", samples.metrics())
    assert [(m.name, len(m.runs)) for m in grouped([*seeds_of("ppo", (0, 1)), other])] == [
        ("ppo", 2),
        ("constant_20_0", 1),
    ]
    same = [Training(f"run{i}", f"a: {i}\n", samples.metrics(), "best") for i in range(2)]
    assert [m.name for m in grouped(same)] == ["run0", "run1"], (
        "a preset with two settings is told apart by its folders"
    )


def test_an_evaluation_in_between_is_shown_with_its_count_and_interval():
    run = Training(
        "a",
        "train:\n  evaluate_episodes: 64\n",
        [*samples.metrics(9), {**samples.metrics(9)[-1], "eval/success_rate": 0.75}],
    )
    assert rows(tables(training([run]))[0])[0][6] == "48/64 = 75.0 % [63.2, 84.0]"
    of_scenes = {"eval/success_pool_6_0.6": 0.9, "eval/success_pool_9_1.5": 0.6}
    run = Training("a", run.config, [run.metrics[-1] | of_scenes])
    assert rows(tables(training([run]))[0])[0][6] == "48/64 = 75.0 %", "scenes share their episodes' numbers"


def test_a_training_without_iterations_says_so():
    assert training([Training("x", "", [])])[0].text == "No iteration was recorded."


@pytest.fixture
def pictured(tmp_path):
    """A run folder with pictures, by their sizes only."""
    sizes = {
        "pictures/seed0_episode0.png": 300, "pictures/seed0_episode7.png": 301,
        "pictures/seed0_episode5.png": 900, "explain/late_bt_seed0_episode7.png": 301,
        "pictures/unknown.png": 50,
    }  # fmt: skip
    for name, size in sizes.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x" * size)
    return tmp_path, samples.evaluation_document(samples.agent("bt"))


def test_the_worst_episodes_come_first(pictured):
    _, pictures = media(*pictured)
    assert [item.caption for item in pictures.items] == [
        "Late, seed 0, episode 7. bt: collision after 17.0 s, closest 0.23 m",
        "Seed 0, episode 7. bt: collision after 17.0 s, closest 0.23 m",
        "Seed 0, episode 5. bt: success after 15.0 s, closest 0.25 m",
        "Seed 0, episode 0. bt: success after 10.0 s, closest 0.30 m",
        "unknown",
    ]
    assert pictures.note == ""


def test_what_does_not_fit_is_named(pictured, monkeypatch):
    monkeypatch.setattr(build, "PICTURE_BYTES", 960)
    _, pictures = media(*pictured)
    assert [len(item.content) for item in pictures.items] == [301, 301, 300, 50]
    assert "pictures/seed0_episode5.png (0.0 MB)" in pictures.note and "run folder" in pictures.note


# ------------------------------------------------------------------------------------------------------- page


class Reader(HTMLParser):
    """What a browser would make of a page: tags, attributes, text outside of tags."""

    def __init__(self, html):
        super().__init__()
        self.tags, self.words = [], []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.words.append(data)

    def of(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


EVIL = "</title><script>alert(1)</script>$x$\"'&"


@pytest.fixture(scope="module")
def evil(tmp_path_factory):
    """Page of an evaluation whose every name wants to be more than a name."""
    name = EVIL.replace("/", ":")
    agent = samples.agent(EVIL, causes=[samples.CAUSE | {"label": EVIL, "meaning": EVIL}], explain=[1])
    folder = tmp_path_factory.mktemp("evil") / name
    document = samples.evaluation_document(agent) | {"world": EVIL}
    samples.write_run(folder, ("uuv", "eval", EVIL), EVIL, eval__result=document)
    return folder, report([folder])


def test_everything_from_files_is_escaped(evil):
    _, written = evil
    page = Reader(written.page.read_text())
    assert not page.of("script") and not page.of("b")
    assert not [key for _, attributes in page.tags for key in attributes if key.startswith("on")]
    assert "".join(page.words).count("alert(1)") > 5, "as words they are there"
    assert [path.name for path in written.figures] == ["agents.png"]


def test_a_page_needs_nothing_but_itself(evil):
    page = Reader(evil[1].page.read_text())
    policy = next(
        meta["content"] for meta in page.of("meta") if meta.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none'") and "script" not in policy
    addresses = [
        value
        for _, attributes in page.tags
        for key, value in attributes.items()
        if key in ("src", "href", "xlink:href")
    ]
    assert addresses and all(address.startswith(("data:", "#")) for address in addresses)
    assert not re.search(r"@import|url\((?!#)", evil[1].page.read_text())


def test_the_same_run_is_the_same_page(evil):
    folder, written = evil
    before = written.page.read_bytes(), [path.read_bytes() for path in written.figures]
    again = report([folder])
    assert (again.page.read_bytes(), [path.read_bytes() for path in again.figures]) == before
    assert not list(folder.rglob("*.tmp"))


TITLES = {
    "bt over S, D, v m/s in pool": {"sweep": samples.sweep_document()},
    "bt, best over sensors in pool": {"sweep": samples.noise_sweep()},
    "Replay: dive.mcap": {"argv": ("uuv", "replay", "there/dive.mcap", "--open")},
    "Training: policy": {"argv": ("uuv", "train", "policy")},
    "folder": {"argv": ("uuv", "drive", "-S", "8")},
    "Profile: folder": {"argv": ("uuv", "profile", "--steps", "8")},
}


@pytest.mark.parametrize(("title", "files"), TITLES.items())
def test_a_page_says_in_its_title_what_it_is_of(title, files, tmp_path):
    samples.write_run(tmp_path / "folder", **files, profile=samples.PROFILE)
    assert build._of_run(tmp_path / "folder").title == title


def test_the_data_of_a_figure_can_be_had_as_csv(tmp_path):
    data = Data(["name", "value"], [["a, b", 0.1], ['"c"', None]])
    html, _ = render(Page("t", "", [], []))
    assert "<h1>t</h1>" in html
    axes = {"S": [8, 12], "D": [0, 15], "v_m_s": [0.2, 3.0]}
    samples.write_run(tmp_path, sweep=samples.sweep_document(axes=axes))
    links = [a for a in Reader(report([tmp_path]).page.read_text()).of("a") if "download" in a]
    head, *rows = (
        csv.DictReader(io.StringIO(unquote(links[0]["href"].split(",", 1)[1]))),
        links[0]["download"],
    )
    cells = list(head)
    assert rows == ["heat_map_bt.csv"]
    assert len(cells) == 6
    assert (cells[-1]["S"], cells[-1]["v_m_s"], cells[-1]["success"], cells[-1]["success_rate"]) == (
        "12", "3.0", "1", "0.0625",
    )  # fmt: skip
    assert data.csv() == 'name,value\n"a, b",0.1\n"""c""",\n'


def test_a_page_says_where_its_figures_come_from(evil):
    text = " ".join(Reader(evil[1].page.read_text()).words)
    for said in ("uuv eval", "some processor", "uuvtai 0.1.0", "2026-01-01T00:00:00+0000", "abc", "3.0 s"):
        assert said in text


def test_a_training_that_was_killed_is_marked_and_shown_without_the_line_that_it_wrote(tmp_path):
    samples.write_run(tmp_path, metrics=rewards(5))
    record = json.loads((tmp_path / "run.json").read_text())
    (tmp_path / "run.json").write_text(json.dumps(record | {"status": "interrupted"}))
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('\n{"iteration": 6, "rollo')
    html = report([tmp_path]).page.read_text()
    assert "<td>5</td>" in html and "marked 'interrupted'" in "".join(Reader(html).words)


def rewards(n):
    """Records of a training with one figure."""
    kept = ("iteration", "time/env_steps", "rollout/ep_rew_mean")
    return [{key: row[key] for key in kept} for row in samples.metrics(n)]


def test_a_damaged_cell_of_one_of_several_runs_names_its_folder(tmp_path):
    runs = [samples.write_run(tmp_path / "whole", profile=samples.PROFILE)]
    damaged = samples.PROFILE | {"paper_latency": [{"component": "Full loop", "mean_ms": "3.1"}]}
    runs.append(samples.write_run(tmp_path / "damaged", profile=damaged))
    with pytest.raises(ConfigError, match=r"/damaged: a result file there is not as this version writes it"):
        report(runs, tmp_path / "page.html")


def test_a_training_and_its_evaluations_are_one_page(tmp_path):
    """The checkpoint's sha256 tells the training; figures of two folders are kept apart. The page is none of
    theirs."""
    trained, again = (
        samples.write_run(tmp_path / name, config=f"train:\n  seed: {i}\n", metrics=rewards(5))
        for i, name in enumerate(("first", "first_1"))
    )
    manifest = trained / "checkpoints/step_000005/manifest.json"
    manifest.parent.mkdir(parents=True)
    manifest.write_text('{"step": 5}')
    shas = {"first_eval": hashlib.sha256(manifest.read_bytes()).hexdigest(), "other_eval": "0" * 64}
    for name, sha in shas.items():
        document = samples.evaluation_document(
            samples.agent("bt"), samples.agent("mine", checkpoint={"sha256": sha})
        )
        samples.write_run(tmp_path / name, eval__result=document)
    runs = [trained, again, *(tmp_path / name for name in shas)]
    written = report(runs, tmp_path / "page.html")
    page = Reader(written.page.read_text())
    titles = ["Training", "Evaluation: first_eval", "Evaluation: other_eval"]
    assert [word for word in page.words if word in titles] == titles * 2, (
        "in the list of sections and above them"
    )
    assert [path.name for path in written.figures] == [
        "training.png",
        "first_eval_agents.png",
        "other_eval_agents.png",
    ]
    text = " ".join(page.words)
    assert "mine is checkpoint step_000005 of the training first." in text
    assert "mine (checkpoint 0000000000000000) is none of the checkpoints" in text
    assert "first (2 seeds)" in text and all(path.exists() for path in written.figures)
    (trained / "report.html").write_text("its own")
    with pytest.raises(UserError, match="--force"):
        report(runs, trained / "report.html")
    samples.write_run(tmp_path / "empty")
    with pytest.raises(ConfigError, match=r"empty: has nothing to report"):
        report([*runs, tmp_path / "empty"], tmp_path / "x.html")


def test_pairs_of_methods_are_told_with_p_and_interval():
    agents = [samples.agent("straight", 3, 5), samples.agent("bt", 8, 0)]
    (pairs,) = [
        table
        for table in tables(evaluation(samples.evaluation_document(*agents) | {"paired": paired(agents)}))
        if table.title.startswith("Pairs")
    ]
    assert rows(pairs) == [
        ["straight", "bt", "8", "3", "0", "5", "0.062", "11.00", "11.00", "0.00 [0.00, 0.00]"]
    ]
    assert pairs.data.rows[0][3:7] == [3, 0, 5, pytest.approx(0.0625)]
    assert not any(
        table.title.startswith("Pairs") for table in tables(evaluation(samples.evaluation_document()))
    )
    nobody = [samples.agent(name, 0, 8) for name in "ab"]
    assert rows(paired_table(paired(nobody), "")) == [["a", "b", "8", "0", "0", "0", "1", "-", "-", "-"]]
    assert rows(paired_table([paired(agents)[0] | {"mcnemar_p": 1e-9}], ""))[0][6] == "< 0.0001"


def test_a_method_has_its_colour_in_charts_and_tables(tmp_path):
    names = ["straight", "planner", "bt", "mine"]
    colours = agent_colours(names)
    document = samples.evaluation_document(*map(samples.agent, names))
    blocks = evaluation(document)
    assert tables(blocks)[0].swatches == [colours[name] for name in names]
    (figure,) = [block for block in blocks if isinstance(block, Figure)]
    root, hover = drawn(figure.panels[0])
    assert [text.split("\n")[0] for text in hover.values()] == names
    bars = {
        e.get("id").removeprefix("f-"): ElementTree.tostring(e, encoding="unicode")
        for e in root.iter()
        if "interval" in (e.get("id") or "")
    }
    for (identity, text), name in zip(hover.items(), names, strict=True):
        assert colours[name] in bars[identity], text
    samples.write_run(tmp_path, eval__result=document)
    swatches = [
        span["style"]
        for span in Reader(report([tmp_path]).page.read_text()).of("span")
        if span.get("class") == "swatch"
    ]
    assert len(swatches) == 2 * len(names)
    assert all(colours[name] in style for name, style in zip(names, swatches[: len(names)], strict=True))


def test_every_colour_of_a_line_has_a_lighter_one_for_the_dark():

    template = (files("uuvtai") / "report/page.html.j2").read_text()
    lighter = dict(re.findall(r"--series-(\d+): (#\w{6})", template))
    assert [int(i) for i in lighter] == list(range(len(PALETTE)))
    for i, colour in enumerate(PALETTE):
        assert contrast(lighter[str(i)], "#12171d") > 5 and contrast(lighter[str(i)], "#12171d") >= contrast(
            colour, "#12171d"
        )


def test_a_page_of_many_episodes_stays_below_ten_megabytes(tmp_path, monkeypatch):
    """Also where it is of several runs, each of which would fit alone."""
    blob = b"A" * (recorded.RECORDING_BYTES - 1000)
    monkeypatch.setattr(build, "packed_episode", lambda files, *_: [blob] * (1 + len(files)))
    runs = []
    for i in range(2):
        run = samples.write_run(
            tmp_path / f"run_{i}", eval__result=samples.evaluation_document(samples.agent("bt"))
        )
        for name, n_files, size in (
            ("pictures/seed1_episode{}.png", 8, 300_000),
            ("logs/bt_seed0_episode{}.mcap", 9, 1),
        ):
            (run / name).parent.mkdir()
            for k in range(n_files):
                (run / name.format(k)).write_bytes(bytes(size))
        runs.append(run)
    for some in (runs[:1], runs):
        page = report(some, tmp_path / f"page_of_{len(some)}.html").page
        assert 7e6 < page.stat().st_size < 10e6
        assert "Left out to keep this page small" in page.read_text()
        assert "logs/bt_seed0_episode" in page.read_text()


# ----------------------------------------------------------------------------------------------- reproduction


def reproduced(folder, *blocks):
    document = {"schema": 1, "title": "The paper", "sections": [{"title": "First", "blocks": list(blocks)}]}
    return samples.write_run(folder, ("uuv", "reproduce"), reproduce=document)


def test_a_reproduction_composes_verdicts_tables_and_runs(tmp_path):
    verdicts = [
        {"claim": "it swims", "verdict": "holds", "numbers": "3 of 3"},
        {"claim": "it flies", "verdict": "does not hold", "numbers": "0 of 3"},
    ]
    folder = reproduced(
        tmp_path,
        {"kind": "verdicts", "items": verdicts},
        {"kind": "table", "columns": ["what", "paper"], "rows": [["bt", None]], "caption": "Table main"},
        {"kind": "run", "path": "grid"},
        {"kind": "run", "path": "noise"},
        {"kind": "curves", "paths": ["a_0", "a_1"]},
    )
    axes = {"S": [4, 8], "D": [3], "v_m_s": [0.2, 0.4]}
    samples.write_run(tmp_path / "grid", sweep=samples.sweep_document(axes=axes))
    samples.write_run(tmp_path / "noise", eval__result=EVALUATED)
    for i in range(2):
        samples.write_run(tmp_path / f"a_{i}", config=f"train:\n  seed: {i}\n", metrics=rewards(5))
    written = report([folder])
    page = Reader(written.page.read_text())
    assert [path.stem for path in written.figures] == ["grid_heat_map_bt", "noise_agents", "training"]
    assert [item["class"] for item in page.of("li")] == ["holds", "fails"]
    assert "a (2 seeds)" in page.words


@pytest.mark.parametrize(
    ("block", "says"),
    [
        ({"kind": "run", "path": "../.."}, "lies outside"),
        ({"kind": "run", "path": "/etc"}, "lies outside"),
        ({"kind": "run", "path": "nothing"}, "is no folder here"),
        ({"kind": "song"}, "'song' is no kind of block"),
        ({"kind": "prose"}, "KeyError: 'text'"),
        (
            {"kind": "verdicts", "items": [{"claim": "a", "verdict": "maybe", "numbers": ""}]},
            "'maybe' is no verdict",
        ),
    ],
)
def test_a_reproduction_that_cannot_be_shown_says_why(tmp_path, block, says):
    with pytest.raises(ConfigError, match=re.escape(says)):
        report([reproduced(tmp_path / "run", block)])
    assert not (tmp_path / "run/report.html").exists()


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("eval/result.json", "{", "is not valid JSON"),
        ("eval/result.json", "[1]", "is no JSON object"),
        ("eval/result.json", '{"schema": 1}', "KeyError: 'agents'"),
        ("sweep.json", '{"cells": [{}], "axes": {"S": [4, 8], "D": [0, 3]}}', "KeyError: 'episodes'"),
        ("metrics.jsonl", '{"iteration": 1}\nnothing\n{"iteration": 2}', "line 2: is no JSON object"),
    ],
)
def test_a_damaged_file_is_one_clear_error_and_nothing_is_written(tmp_path, file, content, says):
    samples.write_run(tmp_path)
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text(content)
    with pytest.raises(ConfigError, match=re.escape(says)) as answer:
        report([tmp_path])
    assert str(tmp_path) in str(answer.value)
    assert not (tmp_path / "report.html").exists() and not (tmp_path / "figures").exists()


@pytest.fixture
def blank(monkeypatch):
    """Figures are empty where only files count."""
    monkeypatch.setattr(ink, "svg", lambda *_panel: "<svg/>")
    monkeypatch.setattr(ink, "png", lambda _panels: b"png")


def test_a_page_that_cannot_be_written_leaves_the_old_one(tmp_path, blank):
    samples.write_run(tmp_path, eval__result=EVALUATED)
    before = report([tmp_path]).page.read_bytes()
    (tmp_path / "wall").write_text("a file")
    with pytest.raises(RunFolderError, match="--out FILE"):
        report([tmp_path], tmp_path / "wall" / "x.html")
    assert (tmp_path / "report.html").read_bytes() == before


# ------------------------------------------------------------------------------------ where it may be written


def test_the_default_page_may_be_renewed(tmp_path, blank):
    run = samples.write_run(tmp_path / "run", eval__result=EVALUATED)
    assert report([run]).page == report([run], run / "report.html").page


@pytest.mark.parametrize(
    "name", ["run/run.json", "run/config.yaml", "run/sweep.json", "run/../run/sweep.json", "link/sweep.json"]
)
def test_a_page_never_replaces_a_file_of_the_run(tmp_path, name):
    run = samples.write_run(tmp_path / "run", sweep=samples.noise_sweep())
    (tmp_path / "link").symlink_to(run)
    before = (tmp_path / name).read_bytes()
    for force in (False, True):
        with pytest.raises(UserError, match="is part of the run"):
            report([run], tmp_path / name, force)
    assert (tmp_path / name).read_bytes() == before
    assert not (run / "figures").exists()


def test_a_page_elsewhere_replaces_files_with_force_only(tmp_path, blank):
    run = samples.write_run(tmp_path / "run", eval__result=EVALUATED)
    (tmp_path / "mine.html").write_text("mine")
    with pytest.raises(UserError, match="--force"):
        report([run], tmp_path / "mine.html")
    assert (tmp_path / "mine.html").read_text() == "mine" and not (tmp_path / "figures").exists()
    written = report([run], tmp_path / "mine.html", force=True)
    assert "<html" in (tmp_path / "mine.html").read_text()
    (tmp_path / "mine.html").unlink()
    written.figures[0].write_text("my figure")
    with pytest.raises(UserError, match="--force"):
        report([run], tmp_path / "mine.html")
    assert written.figures[0].read_text() == "my figure" and not (tmp_path / "mine.html").exists()


@pytest.mark.parametrize("kind", ["page", "figures", "figure"])
def test_a_page_is_not_written_through_a_link(tmp_path, kind, blank):
    run = samples.write_run(tmp_path / "run", eval__result=EVALUATED)
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "agents.png").write_text("precious")
    places = {"page": "page.html", "figures": "page_figures", "figure": "page_figures/agents.png"}
    link = tmp_path / places[kind]
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(tmp_path / "outside" if kind == "figures" else tmp_path / "outside" / "agents.png")
    with pytest.raises(UserError, match="is a link"):
        report([run], tmp_path / "page.html", force=True)
    assert [path.read_text() for path in (tmp_path / "outside").iterdir()] == ["precious"]


@pytest.mark.parametrize(
    ("file", "document", "says"),
    [
        (
            "eval/result.json",
            samples.evaluation_document() | {"agents": [samples.agent("bt")] * 201},
            "agents has 201 entries",
        ),
        ("sweep.json", samples.noise_sweep() | {"cells": [{}] * 20_001}, "cells has 20,001 entries"),
        ("sweep.json", {"cells": [], "axes": {"S": [1] * 10_001}}, "axes.S has 10,001 entries"),
        ("profile.json", {"rows": [{}] * 201}, "rows has 201 entries"),
        (
            "reproduce.json",
            {"title": "x", "sections": [{"title": "y", "blocks": [{"kind": "run", "path": "."}] * 1001}]},
            "1,000 blocks",
        ),
    ],
)
def test_a_small_file_cannot_make_a_page_without_end(tmp_path, file, document, says):
    run = samples.write_run(tmp_path / "run")
    (run / file).parent.mkdir(exist_ok=True)
    (run / file).write_text(json.dumps(document))
    with pytest.raises(ConfigError, match=re.escape(says)):
        report([run])


@pytest.mark.parametrize(("argv", "told"), [
    (["/usr/bin/uuv", "eval", "-S", "8"], "uuv eval -S 8"), (["/lib/uuvtai/cli.py", "eval"], "uuv eval"),
    (["/lib/ipykernel_launcher.py", "-f", "/tmp/x.json"], "called from Python"), ([], ""),
])  # fmt: skip
def test_a_command_is_told_as_it_was_typed(argv, told):
    assert build.command_of({"argv": argv}) == told
