"""Tables at 80, 100 and 120 columns: columns go before cells are cut, and what is left out is said."""

import io
import re

import pytest
from rich.cells import cell_len
from rich.console import Console

from tests import report_samples as samples
from uuvtai.console import views
from uuvtai.console.doctor import show_checks
from uuvtai.console.screen import Screen
from uuvtai.evaluation.results import paired
from uuvtai.report.reproduction import claim_table
from uuvtai.report.tables import PAGE, TERMINAL, Cell, Column, Table, markdown, sensing

WIDTHS = (80, 100, 120)


def shown(show, width, wide=False):
    """What ``show`` prints on a terminal of so many columns."""
    console = Console(file=io.StringIO(), width=width, force_terminal=False)
    show(Screen(wide, console))
    return console.file.getvalue()


def evaluation():
    """Four agents with the longest figures that there are, one of them privileged."""
    names = {"straight": 281, "planner": 290, "bt+truth": 500, "20261122-154501_constant_20": 0}
    agents = [
        samples.agent(name, k, 500 - k, 500, privileged=name == "bt+truth", env_steps_per_s=25123.4)
        for name, k in names.items()
    ]
    return samples.evaluation_document(*agents) | {"remainder": [], "paired": paired(agents)}


def explained():
    cause = samples.CAUSE | {"examples": [[90001, 499]], "label": "unseen_above_or_below"}
    return {"agents": [{"name": "bt", "episodes": 500, "explain": [{}, {}], "causes": [cause]}]}


def simulated():
    n = 40
    return {
        "t": [0.5 * i for i in range(n)],
        "position": [[1.0, -2.0, -10.25]] * n,
        "rpy_deg": [[-179.999] * 3] * n,
        "nu": [[-0.125] * 6] * n,
    }


ENGINE = {
    "engine": "ONNX Runtime 1.31.0", "agrees": True, "p50_ms": 0.123, "p99_ms": 4.567,
    "difference": {"action": 1.2e-7, "uncertainty": 3.4e-6},
}  # fmt: skip
EXPORTED = {
    "folder": "runs/" + "long_" * 20 + "export",
    "engines": [ENGINE, ENGINE],
    "damages": [],
    "agrees": True,
}
LOG = {
    "topics": [{"topic": f"/topic/{i}", "schema": "foxglove.CompressedImage", "messages": 10**i,
    "rate_hz": 50.0} for i in range(6)],
    "duration_s": 12.0, "outcome": "success", "is_eval": True,
}  # fmt: skip
CHECKS = [{"name": "kernel cache", "ok": False, "detail": "word " * 60}]
CLAIMS = {
    "budget": "quick",
    "claims": [
        {"text": "word " * 30, "theirs": "83 %", "ours": "96 % [95, 97]", "verdict": "holds", "reason": ""}
    ],
}
SHOWS = {
    "eval": (lambda s: views.show_agents(s, evaluation()), ["agent", "success [95 %]", "collision [95 %]"]),
    "pairs": (lambda s: views.show_pairs(s, evaluation()["paired"]),
        ["a : b", "only a", "only b", "(McNemar)"]),
    "causes": (lambda s: views.show_causes(s, explained()), ["cause", "n"]),
    "simulate": (lambda s: views.show_simulation(s, simulated(), "bluerov2"), ["t s", "x m", "y m", "z m"]),
    "sweep": (lambda s: views.show_sweep(s, samples.robustness_sweep()),
        ["changed", "agent", "success [95 %]", "collision [95 %]"]),
    "profile": (lambda s: views.show_profile(s, PROFILE), ["us per env-step", "65536 env"]),
    "export": (lambda s: views.show_export(s, EXPORTED, is_ours=True), ["engine"]),
    "log": (lambda s: views.show_log(s, LOG, "x" * 200 + ".mcap"), ["topic", "messages", "Hz"]),
    "doctor": (lambda s: show_checks(s, CHECKS), []),
    "claims": (lambda s: s.table(claim_table(CLAIMS)), ["claim", "the paper", "here", "verdict"]),
    "presets": (views.show_presets, ["gauntlet", "policy"]),
}  # fmt: skip
PROFILE = samples.PROFILE | {
    "rows": [samples.PROFILE["rows"][0] | {"num_envs": 4**i} for i in range(9)],
    "real_time": {
        "p50_ms": 1.0, "p99_ms": 2.0, "max_ms": 3.0, "budget_ms": 20.0, "within": True, "late": 0,
        "steps": 500,
    },
}  # fmt: skip


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", SHOWS)
def test_no_cell_is_cut_and_the_essential_columns_are_there(name, width):
    show, heads = SHOWS[name]
    text = shown(show, width)
    assert "…" not in text and "..." not in text
    assert max(map(cell_len, text.splitlines())) <= width
    for head in heads:
        assert head in text, text


@pytest.mark.parametrize("width", WIDTHS)
def test_rates_of_an_evaluation_stand_whole_in_one_line(width):
    result = evaluation()
    lines = shown(lambda s: views.show_agents(s, result), width).splitlines()
    for m in result["agents"]:
        o = m["outcomes"]
        (row,) = [
            line for line in lines if re.search(rf"\b{o['success']}/500 = .*\b{o['collision']}/500 = ", line)
        ]
        assert row.count("[") == row.count("]") == 2


def test_a_wider_terminal_shows_more_and_what_is_left_out_is_said():
    result = evaluation()
    found = {width: shown(lambda s: views.show_agents(s, result), width) for width in (*WIDTHS, 200)}
    assert "steps/s" in found[200].split("left out")[0] and "left out" not in found[200]
    for width in WIDTHS:
        before, _, after = found[width].partition("left out, for want of room: ")
        answer = after.partition("; --wide shows all")[0]
        assert "steps/s" in answer and "steps/s" not in before, "the least important goes first"
    assert "contact/ttc/" in found[120] and "contact/ttc/" not in found[80].split("left out")[0]
    assert "contact/ttc/ out/timeout" in re.sub(r"\s+", " ", found[80])


@pytest.mark.parametrize("name", SHOWS)
def test_wide_shows_every_column(name):
    text = shown(SHOWS[name][0], 80, wide=True)
    assert "left out" not in text and "…" not in text
    heads = {
        "eval": "steps/s", "simulate": "r rad/s", "profile": "64 env", "causes": "chance", "log": "schema",
        "export": "p99 ms",
    }  # fmt: skip
    assert heads.get(name, "") in text


def test_a_file_is_wide(capsys):
    views.show_agents(Screen(), evaluation())
    out = capsys.readouterr().out
    assert "steps/s" in out and "left out" not in out


def test_essential_cells_that_have_no_room_go_on_in_the_next_line():
    text = shown(
        lambda s: s.table(Table([Column("a", left=True), Column("b")], [["x" * 50, "1"], ["y", "2"]])), 30
    )
    assert text.count("x") == 50 and max(map(len, text.splitlines())) <= 30 and "…" not in text


def test_prose_is_wrapped_before_columns_are_left_out():
    columns = [Column("name", left=True), Column("n", 1), Column("meaning", 0, prose=True)]
    text = shown(lambda s: s.table(Table(columns, [["a", "12345", "some words " * 12]])), 60)
    assert "12345" in text and text.count("words") == 12


def test_what_a_file_brought_along_is_no_markup_and_steers_nothing():
    text = shown(
        lambda s: s.table(Table([Column("[red]", left=True)], [["[/x] \x1b[2J"]], "[/no] [bold]")), 80
    )
    assert "[/x] ?[2J" in text and "[red]" in text and "[/no] [bold]" in text


def test_a_grid_is_read_without_colour_and_leaves_out_what_has_no_room():
    text = shown(lambda s: views.show_sweep(s, samples.sweep_document()), 80)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    row = next(i for i, line in enumerate(lines) if line.startswith("12 · 15 "))
    assert lines[row] == "12 · 15 94 / 0 88 / 6 81 / 6 75 / 12 50 / 25 6 / 44"
    assert len(lines[row + 1].split()) == 6 and "\x1b" not in text
    speeds = [0.1 * i for i in range(1, 16)]
    document = samples.sweep_document(axes={"S": [4, 8], "D": [6], "v_m_s": speeds})
    text = shown(lambda s: views.show_sweep(s, document), 80)
    assert max(map(len, text.splitlines())) <= 80 and "…" not in text
    assert "left out, for want of room: " in text and "1.4, 1.5; --wide" in text
    whole = shown(lambda s: views.show_sweep(s, document), 80, wide=True)
    assert len(re.findall(r"\d+ / \d+", whole)) == len(document["cells"])


def test_long_values_of_an_axis_are_not_cut():
    axes = {"S": [4, 8], "sensors.localization": ["truth", "dead_reckoning_with_drift"]}
    cells = [
        {"S": s, "sensors.localization": v, "agent": "bt", **samples.rates(9, 3)}
        for s in axes["S"]
        for v in axes["sensors.localization"]
    ]
    text = shown(lambda s: views.show_sweep(s, {"world": "pool", "axes": axes, "cells": cells}), 80)
    assert "dead_reckoning_with_drift" in text and "…" not in text


def test_every_preset_has_a_sentence():
    for kind, found in views.sentences().items():
        for name, said in found.items():
            assert said.endswith(".") and 15 < len(said) < 250 and not said.startswith(("#", "<")), (
                f"{kind}/{name}: {said}"
            )


def test_one_table_is_shown_in_the_terminal_and_on_a_page_each_in_its_way():
    columns = [
        Column("name", left=True, of=lambda row: row["name"]),
        Column("time to goal s", short="time", of=lambda row: Cell(row["time"], "short")),
        Column("terminal's", only=TERMINAL, of=lambda row: row["terminal"]),
        Column("page's", only=PAGE, of=lambda row: row["page"]),
    ]
    row = {"name": "a|b", "time": "in full"}
    assert markdown(Table(columns, [row | {"page": "p"}], "title")) == (
        "| name | time to goal s | page's |\n| --- | --- | --- |\n| a\\|b | in full | p |"
    )
    title, head, _rule, line = shown(
        lambda s: s.table(Table(columns, [row | {"terminal": "t"}], "title")), 80
    ).splitlines()
    assert (title.strip(), head.split(), line.split()) == (
        "title",
        ["name", "time", "terminal's"],
        ["a|b", "short", "t"],
    )


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ({"localization": "truth"}, "harsh sensing, position known"),
        ({"localization": "dead_reckoning"}, "harsh sensing, dead reckoning"),
        ({"localization": "estimated"}, "harsh sensing, position estimated"),
        ({}, "harsh sensing"),
    ],
)
def test_what_was_sensed_says_how_the_position_was_found(found, said):
    assert sensing({"sensors": "harsh", **found}) == said
