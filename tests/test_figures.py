"""Figures in README and docs: each comes out of a committed results file, and one that does not, or not any
more, is caught."""

import json
import shlex
import shutil
import subprocess

import pytest

from docs.writers import evaluations, figure_tables, figures, pieces, reproduction, sweeps
from docs.writers.figure_sources import ROOT, Counts, SourceError, Sources, fitting, pooled, weighted
from docs.writers.figure_words import GENERATED, KINDS, LOGS, PARAMETER_PAGES, unmarked
from tests.test_docs import fault

SOURCES = Sources()


# -------------------------------------------------------------------------------------------------- the pages


@pytest.mark.parametrize("path", figures.pages(), ids=lambda path: path.stem)
def test_no_figure_is_stale_and_none_is_without_a_source(path):
    """Where this fails: ``python -m docs.writers.figures`` renews what is marked and lists what is not
    (CONTRIBUTING.md)."""
    assert figures.faults(path, SOURCES) == []


def test_the_page_of_results_is_what_its_data_give():
    assert (ROOT / reproduction.PAGE).read_text() == reproduction.page()


def test_pages_named_in_lists_are_there_and_every_table_is_used():
    for name in (*LOGS, *GENERATED, *PARAMETER_PAGES):
        assert (ROOT / name).exists(), name
    text = "".join(path.read_text() for path in figures.pages())
    used = {found["name"] for found in figures.TABLE.finditer(text)}
    assert used <= set(figure_tables.TABLES) and len(used) >= 8
    assert len(figures.MARK.findall(text)) > 30


# ------------------------------------------------------------------------------------------ a copy gone wrong


@pytest.fixture
def copy(tmp_path):
    """What is watched and what it rests on, in a folder of its own."""
    shutil.copytree(
        ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("reference", "__pycache__", "*.png")
    )
    shutil.copytree(ROOT / "benchmarks/results", tmp_path / "benchmarks/results")
    shutil.copy(ROOT / "README.md", tmp_path / "README.md")
    return tmp_path


def changed(root, page, old, new):
    text = (root / page).read_text()
    assert old in text
    (root / page).write_text(text.replace(old, new, 1))
    return "\n".join(figures.faults(root / page, Sources(root)))


def test_a_figure_that_was_rounded_up_is_caught(copy):
    mark = "<!-- = sweep.pool[bt;moderate].success_rate:.1% -->"
    right = f"{100 * SOURCES.value('sweep.pool[bt;moderate].success_rate'):.1f}"
    assert right in (copy / "README.md").read_text()
    answer = changed(copy, "README.md", f"{right}{mark}", f"{float(right) + 0.1:.1f}{mark}")
    assert "README.md" in answer and f"{right}<!-- =" in answer and "the results say" in answer


def test_a_cell_of_a_table_that_was_changed_by_hand_is_caught(copy):
    title, success, *_ = figure_tables._evaluated(SOURCES.evaluations()["rows"][0])
    answer = changed(copy, "README.md", f"| {title} | {success}", f"| {title} | 1{success}")
    assert "the results say" in answer


def test_results_that_move_on_leave_the_text_behind(copy):
    """The other way round: somebody measures again and forgets the text."""
    newer = copy / "benchmarks/results/2999-01-01_cpu_scale.json"
    document = SOURCES.benchmark("scale")
    rows = [row | {"ours": 2 * row["ours"]} for row in document["rows"]]
    newer.write_text(json.dumps(document | {"rows": rows}))
    before = SOURCES.value("bench.scale[paper sensing].ours")
    sources = Sources(copy)
    answer = "\n".join(figures.faults(copy / "README.md", sources))
    assert f"{before:,.0f}" in answer and f"{2 * before:,.0f}" in answer
    (copy / "README.md").write_text(figures.renewed((copy / "README.md").read_text(), sources))
    assert figures.faults(copy / "README.md", sources) == []


def test_a_mark_that_leads_nowhere_says_what_there_is(copy):
    answer = changed(
        copy,
        "README.md",
        "evaluations.pool_0.straight/bt.time_ratio",
        "evaluations.pol_0.straight/bt.time_ratio",
    )
    assert "no row 'pol_0'" in answer and "pool_0" in answer


def test_the_page_of_results_changed_by_hand_is_caught(copy):
    (copy / "docs/results.md").write_text(
        (copy / "docs/results.md").read_text().replace("| holds |", "| HOLDS |", 1)
    )
    assert (copy / "docs/results.md").read_text() != reproduction.page(copy)


# ----------------------------------------------------------------------------------------------- what is seen


@pytest.mark.parametrize(
    "line",
    [
        "success is 98.0 % here",
        "490/500 arrive",
        "an interval of [96.3, 98.9]",
        "83.4 / 13.2 in harsh water",
        "it does 25,100 env-steps/s",
        "which is 3 times as fast",
        "in 14 s",
        "a gain of 2 points",
        "McNemar p = 0.05",
        "AUROC 0.73",
        "0.27 (0.26 .. 0.28)",
        "| `pool` | 12.2 |",
        "| `pool` | **97.6 %** [95.9, 98.6] |",
        "12.5<!-- = sweep.pool[bt].success_rate:.1% --> % and 14.2 % more",
    ],
)
def test_figures_without_a_source_are_seen(line):
    assert [number for number, _answer in unmarked("docs/x.md", f"# Title\n\n{line}\n")] == [3] * len(
        list(unmarked("docs/x.md", line))
    )
    assert list(unmarked("docs/x.md", line)), line


@pytest.mark.parametrize(
    "line",
    [
        "12.5<!-- = sweep.pool[bt].success_rate:.1% --> % of them",
        "96.5 % [95.6, 97.2]<!-- = a.b ; a.c ; a.d --> arrive",
        "within 2 s<!-- definition --> of it",
        "pool (8, 6, 0.6) at v = 1.5 m/s",
        "`--seconds 5 s` and `98.0 %`",
        "95 % Wilson intervals",
        "a beam of 10 deg, 12 m long",
        "<!-- figures: theirs -->\nthe paper prints 82.8 %",
        "```sh\nuuv eval  # 98 %\n```",
        "<!-- table: grid -->\n| 98.0 % |\n<!-- end -->",
    ],
)
def test_what_is_marked_or_no_result_is_left_alone(line):
    assert list(unmarked("docs/x.md", line)) == []


def test_a_kind_holds_until_the_next_heading():
    text = "# A\n<!-- figures: parameter -->\n5 s\n\n6 s\n\n## B\n7 s\n"
    assert [number for number, _answer in unmarked("docs/x.md", text)] == [8]
    assert "no kind 'guess'" in next(unmarked("docs/x.md", "<!-- figures: guess -->"))[1]
    assert {"parameter", "definition", "theirs", "log"} <= KINDS.keys()


def test_logs_say_that_they_are_logs_and_that_the_raw_file_was_not_kept():
    assert "nowhere says" in next(unmarked("docs/x.md", "<!-- figures: log 2026-11-22 -->\nit took 5 s"))[1]
    assert (
        list(
            unmarked("docs/x.md", "<!-- figures: log 2026-11-22 -->\nit took 5 s; the raw file was not kept")
        )
        == []
    )
    assert "does not say so" in next(unmarked("docs/history.md", "# Speed\nit took 5 s"))[1]


def test_parameter_pages_may_hold_times_but_no_rates():
    assert list(unmarked("docs/simulator.md", "a step of 0.02 s")) == []
    assert list(unmarked("docs/simulator.md", "which arrives in 98.0 %")) != []


# ---------------------------------------------------------------------------------------------------- sources


def test_counts_by_hand():
    counts = Counts(500, {"success": 490, "collision": 7, "ttc": 2, "out_of_tank": 1, "timeout": 0}, 13.4)
    assert (counts.field("success"), counts.field("success_of"), counts.field("success_rate")) == (
        490,
        "490/500",
        0.98,
    )
    assert (counts.field("collision"), counts.field("contact"), counts.field("out_of_tank_rate")) == (
        10,
        7,
        0.002,
    )
    assert (counts.field("time_s"), counts.field("episodes")) == (13.4, 500)
    # Wilson by hand: (0.98 + z2 / 1000 -+ z sqrt(0.98 0.02 / 500 + z2 / 10^6)) / (1 + z2 / 500), z2 = 3.8415
    assert counts.field("success_low") == pytest.approx(0.96358, abs=1e-5)
    assert counts.field("success_high") == pytest.approx(0.98910, abs=1e-5)
    with pytest.raises(SourceError, match="not kept"):
        Counts(500, {"success": 490, "collision": None}).field("collision")
    with pytest.raises(SourceError, match="no field"):
        counts.field("success_ratio")


CELLS = [
    {
        "S": "4",
        "D": "0",
        "v_m_s": "",
        "method": "bt",
        "episodes": "10",
        "success": "10",
        "contact": "0",
        "ttc_stop": "0",
    },
    {
        "S": "4",
        "D": "3",
        "v_m_s": "0.2",
        "method": "bt",
        "episodes": "10",
        "success": "8",
        "contact": "1",
        "ttc_stop": "0",
    },
    {
        "S": "4",
        "D": "3",
        "v_m_s": "3.0",
        "method": "bt",
        "episodes": "10",
        "success": "2",
        "contact": "4",
        "ttc_stop": "2",
    },
    {
        "S": "4",
        "D": "3",
        "v_m_s": "0.2",
        "method": "best",
        "episodes": "10",
        "success": "9",
        "contact": "0",
        "ttc_stop": "0",
    },
]
CELLS = [cell | {"out_of_tank": "0", "timeout": "0", "time_to_success_mean_s": "10.0"} for cell in CELLS]


def test_cells_are_chosen_and_pooled_by_hand():
    assert pooled(fitting(CELLS, ["bt"])).field("success_of") == "20/30"
    assert pooled(fitting(CELLS, ["bt", "v_m_s<=1.5"])).field("success_of") == "18/20", (
        "where nothing moves it is slow enough"
    )
    assert pooled(fitting(CELLS, ["bt", "v_m_s=3.0"])).field("collision") == 6
    assert pooled(fitting(CELLS, ["moderate", "best"])).field("success_of") == "9/10"
    # two speeds: the cell in which nothing moves counts twice
    assert weighted(fitting(CELLS, ["bt"])).field("success_of") == "30/40"
    with pytest.raises(SourceError, match="no cell"):
        fitting(CELLS, ["bt", "D>=9"])
    with pytest.raises(SourceError, match="no axis 'v'"):
        fitting(CELLS, ["v<=1.5"])


@pytest.mark.parametrize(
    ("part", "shown"),
    [
        ("paper.MODERATE_SUCCESS:.1%", "82.8"),
        ("paper.LOOP_MS:.2f", "28.63"),
        ("bench.dynamics[torch].ratio:.1f", "9.9"),
        ("min(bench.clearance.ratio):.1f", "2.8"),
        ("bench.world_model[conformal miss rate].note/alarm in (\\d+) %/:.0f", "98"),
        ("sweep.pool.about.seeds", "90001"),
    ],
)
def test_paths(part, shown):
    """Of files of a date that stay as they are; newer ones would come beside them."""
    if part.startswith(("bench", "min", "sweep")):
        assert figures.shown(part, SOURCES).replace(",", "").replace(".", "").isdigit()
    else:
        assert figures.shown(part, SOURCES) == shown


@pytest.mark.parametrize(
    ("path", "answer"),
    [
        ("paper.NOTHING", "has no NOTHING"),
        ("guess.x", "begins with none of"),
        ("bench.scale[sensing].ours", "2 rows hold"),
        ("bench.nothing.ours", "no results of benchmark"),
        ("sweep.nothing[bt].success", "no sweep 'nothing'"),
        ("sweep.pool.success", "wanted: sweep.NAME"),
        ("evaluations.pool_6.bt2.success", "no method 'bt2'"),
        ("bench.world_model[conformal].note/nowhere (\\d+)/", "is not in"),
    ],
)
def test_wrong_paths_say_why(path, answer):
    with pytest.raises(SourceError, match=answer):
        SOURCES.value(path)


def test_the_newest_results_of_a_benchmark_are_taken(tmp_path):
    (tmp_path / "benchmarks/results").mkdir(parents=True)
    for date, rate in (("2026-01-02", 2), ("2025-12-31", 1)):
        row = {"what": "w", "peer_name": "", "ours": rate, "details": {}}
        (tmp_path / f"benchmarks/results/{date}_cpu_scale.json").write_text(json.dumps({"rows": [row]}))
    (tmp_path / "benchmarks/results/2026-05-05_cpu_upscale.json").write_text(json.dumps({"rows": []}))
    assert Sources(tmp_path).value("bench.scale[w].ours") == 2


# ------------------------------------------------------------------------------------------------ evaluations


@pytest.mark.parametrize("row", evaluations.ROWS, ids=lambda row: row.name)
def test_every_row_is_a_command_that_can_be_parsed(row):
    assert fault(evaluations.command_of(row, 77, 5)) is None


@pytest.mark.parametrize("name", evaluations.SWEEPS)
def test_every_sweep_is_a_command_that_can_be_parsed(name):
    assert fault(["sweep", *shlex.split(evaluations.SWEEPS[name]), "--seeds", "77"]) is None


def test_names_of_rows_are_one_each_and_the_default_holds_them():
    names = [row.name for row in evaluations.ROWS]
    assert len(set(names)) == len(names) and set(names) < set(evaluations.BY_DEFAULT)
    assert {"pool_6_harsh_dead_reckoning", "pool_6_paper"} <= set(names)


def result(success=3, n=4):
    """What ``uuv eval --json`` says of one method."""
    outcomes = {"success": success, "collision": n - success, "ttc": 0, "out_of_tank": 0, "timeout": 0}
    causes = (
        [{"label": "unseen", "count": n - success, "share": 1.0, "meaning": "m", "examples": []}]
        if success < n
        else []
    )
    method = {
        "episodes": n,
        "outcomes": outcomes,
        "time_mean_s": 9.0,
        "time_to_success_mean_s": 10.0,
        "causes": causes,
    }
    pair = {
        "a": "straight",
        "b": "bt",
        "both": 2,
        "only_a": 0,
        "only_b": 1,
        "mcnemar_p": 1.0,
        "time_difference_mean_s": -0.5,
    }
    pair |= {"time_a_mean_s": 10.0, "time_b_mean_s": 10.5, "time_difference_ci95": None}
    return {
        "methods": [method | {"name": name, "episodes_detail": []} for name in ("straight", "bt")],
        "paired": [pair],
    }


def test_a_row_is_kept_small_and_shown_from_what_is_kept(tmp_path):
    row = evaluations.ROWS[0]
    entry = evaluations.entry_of(row, "uuv eval", result(), "abc", "today")
    assert "episodes_detail" not in json.dumps(entry)
    path = tmp_path / "docs/data/evaluations_77.json"
    evaluations.add(path, evaluations.read(path, 77, 4), entry)
    (path.parent / "shown.json").write_text(json.dumps({"evaluations": path.name}))
    sources = Sources(tmp_path)
    assert sources.value(f"evaluations.{row.name}.bt.success_of") == "3/4"
    assert sources.value(f"evaluations.{row.name}.straight/bt.time_ratio") == pytest.approx(1.05)
    other = evaluations.Row("x", "`x`", "", "", "straight")
    shown = figure_tables._evaluated(evaluations.entry_of(other, "uuv eval", result(), "abc", "today"))
    assert shown[0] == "`x`" and shown[1].startswith("3/4"), "a row may show another method than bt"
    assert f"| {row.title} | 3/4 = 75.0 %" in figure_tables.evaluations(sources)
    evaluations.add(path, evaluations.read(path, 77, 4), entry | {"older": True})
    line = figure_tables.evaluations(Sources(tmp_path)).splitlines()[2]
    assert f"| {row.title} † | 3/4 = 75.0 %" in line, "another default pilot played it"
    assert "| 1 / 0 / 0 / 0 |" in line and "unseen 1" in line
    assert "seed 77" in figure_tables.measured(sources) and "never used for tuning" in figure_tables.measured(
        sources
    )


def test_what_was_played_by_this_code_is_not_played_again(tmp_path, monkeypatch):
    path, played = tmp_path / "evaluations_77.json", []

    def play(row, seed, episodes, commit):
        played.append(row.name)
        if row.name == "maze_0" and len(played) == 2:
            raise RuntimeError("killed")
        return evaluations.entry_of(row, "uuv eval", result(), commit, "today")

    monkeypatch.setattr(evaluations, "_play", play)
    monkeypatch.setattr(evaluations, "commit_of_package", lambda: "abc")
    arguments = [
        "--seeds",
        "77",
        "--episodes",
        "4",
        "--out",
        str(path),
        "--only",
        "pool_6,maze_0,netpen",
        "--jobs",
        "1",
    ]
    assert evaluations.main(arguments) == 1, "one row failed; the others are kept"
    assert evaluations.main(arguments) == 0
    assert played == ["pool_6", "maze_0", "netpen", "maze_0"]
    assert [row["name"] for row in json.loads(path.read_text())["rows"]] == ["pool_6", "maze_0", "netpen"], (
        "in the order of the table"
    )
    monkeypatch.setattr(evaluations, "commit_of_package", lambda: "def")
    assert evaluations.main(arguments) == 0 and len(played) == 7, "other code, other results"


def test_one_more_pilot_is_played_beside_those_that_a_row_has(tmp_path, monkeypatch):
    path, played = tmp_path / "evaluations_77.json", []

    def play(row, seed, episodes, commit):
        played.append((row.name, row.methods))
        document = result()
        document["methods"][1]["name"] = row.shows
        return evaluations.entry_of(row, f"uuv eval {row.methods}", document, commit, "today")

    monkeypatch.setattr(evaluations, "_play", play)
    monkeypatch.setattr(evaluations, "commit_of_package", lambda: "abc")
    given = ["--seeds", "77", "--episodes", "4", "--out", str(path), "--jobs", "1"]
    assert evaluations.main([*given, "--only", "maze_0,pool_6_paper"]) == 0
    before = json.loads(path.read_text())["rows"]
    monkeypatch.setattr(evaluations, "commit_of_package", lambda: "def")
    assert evaluations.main([*given, "--beside", "best"]) == 0
    assert played[2:] == [("maze_0", "--controller best")], "not the paper's row, nor rows never played"
    after = json.loads(path.read_text())["rows"]
    best = after[0]["methods"].pop("best")
    assert after == before, "the others stay as they were played"
    assert (best["command"], best["commit"]) == ("uuv eval --controller best", "def")
    assert evaluations.main([*given, "--beside", "best"]) == 0 and len(played) == 3, "it is there"


def played_alone(outcomes):
    """What ``uuv eval --json`` says of one method, an episode a letter of the kept file."""
    names = {letter: name for name, letter in pieces.LETTERS.items()}
    detail = [{"outcome": names[letter]} for letter in outcomes]
    return {"methods": [{"episodes_detail": detail, "time_to_success_mean_s": 12.0}]}


@pytest.mark.parametrize(
    "turn", pieces.turns_of([], [], ROOT, "abc"), ids=lambda turn: f"{turn.piece.name}-{turn.cell.name}"
)
def test_every_piece_is_a_command_that_can_be_parsed(turn):
    assert fault(pieces.command_of(turn.piece, turn.cell, 77, 5)) is None


def test_a_piece_switched_off_stands_beside_the_whole_pilot(tmp_path):
    path = tmp_path / "docs/data/pieces_77.json"
    path.parent.mkdir(parents=True)
    document = pieces.read(path, 77)
    for piece, outcomes in (
        ("all", "ssstc"), ("depth", "sstxo"), ("all", "ssssc"), ("diagonal", "sssxc"), ("before", "ssttc"),
    ):  # fmt: skip
        pieces.add(path, document, pieces.entry_of(piece, "pool_6", ["eval"], played_alone(outcomes), "abc"))
    (path.parent / "shown.json").write_text(json.dumps({"pieces": path.name}))
    lines = figure_tables.switched_off(Sources(tmp_path)).splitlines()[2:]
    assert [line.split(" | ")[-1].strip(" |") for line in lines] == [
        "80.0 / 20.0",
        "40.0 / 40.0 (+0 -2, p = 0.5)",
        "60.0 / 40.0 (+0 -1, p = 1)",
        "40.0 / 20.0 (+0 -2, p = 0.5)",
        "60.0 / 40.0 (+1 -0, p = 1)",
    ]
    assert sorted(row["piece"] for row in pieces.read(path, 77)["rows"]) == [
        "all", "before", "depth", "diagonal",
    ], "the newer counts"  # fmt: skip


def test_only_pieces_that_this_code_did_not_play_are_played(tmp_path, monkeypatch):
    path, played = tmp_path / "pieces.json", []

    def play(turn, seed, episodes):
        played.append(turn.piece.name)
        if len(played) == 2:
            raise RuntimeError("killed")
        return pieces.entry_of(turn.piece.name, turn.cell.name, [], played_alone("s" * episodes), turn.commit)

    monkeypatch.setattr(pieces.Turn, "play", play)
    monkeypatch.setattr(pieces, "commit_of_package", lambda: "abc")
    given = [
        "--seeds",
        "77",
        "--episodes",
        "3",
        "--only",
        "all,depth,diagonal",
        "--cells",
        "pool_6",
        "--jobs",
        "1",
        "--out",
    ]
    assert pieces.main([*given, str(path)]) == 1, "one row failed; the others are kept"
    assert pieces.main([*given, str(path)]) == 0 and played == ["all", "depth", "diagonal", "depth"]
    assert pieces.main([*given, str(path), "--episodes", "4"]) == 0 and len(played) == 7, "fewer were played"
    assert pieces.main(["--seeds", "77", "--only", "deep", "--out", str(path)]) == 2


def test_a_file_of_another_seed_and_unknown_names_are_refused(tmp_path, capsys):
    path = tmp_path / "evaluations.json"
    path.write_text(json.dumps({"schema": 1, "seed": 77, "episodes": 4, "rows": []}))
    assert (
        evaluations.main(["--seeds", "78", "--out", str(path)]) == 2 and "seed 77" in capsys.readouterr().err
    )
    assert evaluations.main(["--seeds", "78", "--only", "pol_6"]) == 2 and "pool_6" in capsys.readouterr().err


def test_the_commit_is_the_last_that_changed_the_package(tmp_path):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        done = subprocess.run(
            ["git", "-C", str(tmp_path), *identity, *arguments], capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    (tmp_path / "uuvtai").mkdir()
    (tmp_path / "uuvtai/a.py").write_text("1")
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "code")
    code = git("rev-parse", "HEAD")
    (tmp_path / "README.md").write_text("1")
    git("add", ".")
    git("commit", "-qm", "text")
    assert evaluations.commit_of_package(tmp_path) == code
    (tmp_path / "uuvtai/a.py").write_text("2")
    assert evaluations.commit_of_package(tmp_path) == code + "+"


def test_a_sweep_is_kept_as_the_text_reads_it(tmp_path):
    run, root = tmp_path / "run", tmp_path / "root"
    run.mkdir()
    (root / "docs/data").mkdir(parents=True)
    outcomes = {"success": 7, "collision": 1, "ttc": 1, "out_of_tank": 0, "timeout": 1}
    cell = {"method": "bt", "episodes": 10, "outcomes": outcomes, "time_to_success_mean_s": 12.3456}
    cells = [
        cell | {"S": 8, "D": 0, "v_m_s": None},
        cell | {"S": 8, "D": 6, "v_m_s": 0.6, "teacher.caution": [0.5, 1]},
    ]
    sweep = {
        "axes": {"S": [8], "D": [0, 6], "v": [0.6], "teacher.caution": [1]},
        "seeds": [77],
        "episodes_per_seed": 10,
        "cells": cells,
    }
    (run / "sweep.json").write_text(json.dumps(sweep))
    argv = ["/somewhere/uuv", "sweep", "best", "--run-dir", "/somewhere/runs/x", "--json"]
    (run / "run.json").write_text(
        json.dumps({"argv": argv, "started": "today", "git_sha": "abc", "wall_s": 1.5})
    )
    sweeps.keep(run, "small", root)
    sources = Sources(root)
    assert (
        sources.value("sweep.small[bt].success_of") == "14/20"
        and sources.value("sweep.small[D=0].collision") == 2
    )
    assert sources.value("sweep.small.about.command") == "uuv sweep best", "without the machine's paths"
    assert (
        sources.cells("small")[1]["teacher.caution"] == "[0.5, 1]"
        and sources.cells("small")[0]["v_m_s"] == ""
    )


def test_a_sweep_of_one_axis_at_a_time_leaves_out_what_is_unchanged(tmp_path):
    (tmp_path / "docs/data").mkdir(parents=True)
    outcomes = {"success": 1, "collision": 0, "ttc": 0, "out_of_tank": 0, "timeout": 0}
    cell = {
        "method": "bt",
        "episodes": 1,
        "outcomes": outcomes,
        "time_to_success_mean_s": None,
        "S": 8,
        "v_m_s": 0.6,
    }
    sweep = {
        "axes": {"D": [9], "sensors": ["harsh"]},
        "unchanged": {"D": 6, "sensors": None},
        "seeds": [77],
        "episodes_per_seed": 1,
    }
    sweep["cells"] = [cell | {"D": 6}, cell | {"D": 9}, cell | {"D": 6, "sensors": "harsh"}]
    (tmp_path / "sweep.json").write_text(json.dumps(sweep))
    (tmp_path / "run.json").write_text(json.dumps({"argv": ["uuv"], "started": "today"}))
    sweeps.keep(tmp_path, "alone", tmp_path)
    assert [(cell["D"], cell["sensors"]) for cell in Sources(tmp_path).cells("alone")] == [
        ("", ""),
        ("9", ""),
        ("", "harsh"),
    ]
