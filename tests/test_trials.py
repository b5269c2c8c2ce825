"""Tables of trials in the docs say what the committed outcomes of single episodes say."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from docs.writers.forecasts import with_spread
from docs.writers.turn_backs import what_came
from uuvtai.forecast_codes import N_MODE
from uuvtai.statistics import mcnemar_p

DOCS = Path(__file__).parents[1] / "docs"
COLLIDED = set("cxo")
PILOTS = [
    "the pilot before",
    "free depth, edges at 0.2 m, vertical_weight 2, diagonal cruise; weight_seen 0",
    "and motion at first sight",
    "free depth, edges at 0.2 m, vertical_weight 2, diagonal cruise; weight_seen 0.3",
    "and turn_back_s (0.5, 1.2, 2.2), future_margin 1, heed_share 0.2",
    "and turn_back_s (0.5, 1.2, 2.2), future_margin 0.3, heed_share 0.2",
    "and motion at first sight, turn_back_s (0.4, 0.8), heed_share 0.5",
]
"""rows of the table of pilots, in its order"""

QUIET = [
    (77001, "off"),
    (77001, "seen 20"),
    (77001, "seen 60"),
    (77001, "seen 20, room 0.7"),
    (77001, "prior 3, room 0.7"),
    (77002, "off"),
    (77002, "seen 20"),
]
"""rows of the table of quiet water, in its order: seed, weights"""


def table(page, heading, header):
    """Cells of the first table below a heading whose header begins so."""
    text = (DOCS / page).read_text()
    text = text[text.index(heading) :]
    lines = text[text.index(header) :].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def rates(outcomes):
    return [100 * share / len(outcomes) for share in (outcomes.count("s"), count_collided(outcomes))]


def count_collided(outcomes):
    return sum(outcome in COLLIDED for outcome in outcomes)


def paired(one, other):
    """(episodes that ``one`` alone arrives in, that ``other`` alone does)."""
    both = list(zip(one, other, strict=True))
    return sum(a == "s" != b for a, b in both), sum(b == "s" != a for a, b in both)


def told(cell):
    """(success, collision) of '90.3 / 6.0 ...'."""
    first, second = cell.split(" / ")[:2]
    return [float(first), float(second.split(",")[0].split(" (")[0])]


@pytest.mark.parametrize(("column", "cell"), [(1, "pool15"), (2, "gaunt15")])
def test_pilots_are_as_their_episodes_say(column, cell):
    rows = json.loads((DOCS / "data/pilot_trials_77001.json").read_text())["rows"]
    kept = {row["pilot"]: row["outcomes"][:300] for row in rows if row["cell"] == cell}
    cells = [row[column] for row in table("tuning.md", "## Depth, diagonal", "| step |")]
    for name, text in zip(PILOTS, cells, strict=True):
        if text.strip(" |") == "-":
            continue
        assert told(text.strip(" |")) == pytest.approx(rates(kept[name]), abs=0.051), name
        if "(+" in text:
            won, lost = paired(kept[name], kept[PILOTS[0]])
            assert f"(+{won} -{lost}, p < 0.001)" in text and mcnemar_p(won, lost) < 0.001


@pytest.mark.parametrize(("column", "cell"), [(1, "pool15"), (2, "gaunt15")])
def test_quiet_water_is_as_its_episodes_say(column, cell):
    rows = json.loads((DOCS / "data/quiet_trials.json").read_text())["rows"]
    kept = {(row["seed"], row["quiet"]): row["outcomes"] for row in rows if row["cell"] == cell}
    found = table("tuning.md", "## Quiet water", "| seed |")
    for (seed, name), cells in zip(QUIET, found, strict=True):
        text = cells[column + 1].strip(" |")
        if text == "-":
            assert (seed, name) not in kept
            continue
        own = kept[seed, name]
        assert cells[0].strip(" |") == str(seed) and len(own) == 300
        assert told(text) == pytest.approx(rates(own), abs=0.051), name
        won, lost = paired(own, kept[seed, "off"])
        expected = "" if name == "off" else f" (+{won} -{lost}, p = {mcnemar_p(won, lost):.2f})"
        assert text.endswith(expected) and ("(" in text) == (name != "off"), name


def test_first_seconds_are_as_their_episodes_say():
    kept = json.loads((DOCS / "data/first_seconds_77001.json").read_text())
    starts = {(row["pilot"], row["cell"]): row for row in kept["starts"]}
    found = table("tuning.md", "## The first seconds", "| first action |")
    for first, *cells in found:
        name = first.strip(" |").removeprefix("the same, ")
        for cell, text in zip(("pool15", "gaunt15"), cells, strict=True):
            row = starts.get((name, cell))
            assert text.strip(" |") == ("-" if row is None else str(len(row["collided"]))), (name, cell)
            assert row is None or row["episodes"] == 1500
    assert sum(text.strip(" |") != "-" for _, *cells in found for text in cells) == len(starts)


def test_unseen_bodies_are_as_measured():
    kept = json.loads((DOCS / "data/first_seconds_77001.json").read_text())
    outcomes = {(row["pilot"], row["cell"]): row["outcomes"] for row in kept["rows"]}
    for name, *cells in table("tuning.md", "## The first seconds", "| who may have"):
        pilot = "as it is" if name == "off" else name
        for cell, text in zip(("pool15", "gaunt15"), cells, strict=True):
            assert told(text.strip(" |")) == pytest.approx(rates(outcomes[pilot, cell]), abs=0.051), name
            won, lost = paired(outcomes[pilot, cell], outcomes["as it is", cell])
            assert pilot == "as it is" or text.strip(" |").endswith(f"(+{won} -{lost})")
    bins = {row["pilot"]: row["bins"] for row in kept["calibration"]}
    names = ["as it is", "bodies above or below the fan", "all bodies out of sight"]
    for nth, (_, *cells) in enumerate(table("tuning.md", "## The first seconds", "| unseen for |")):
        for name, text in zip(names, cells, strict=True):
            measured = bins[name][nth]
            share, error = text.strip(" |").split(" %, ")
            assert float(share) == pytest.approx(100 * measured["within_95"], abs=0.51)
            assert float(error) == pytest.approx(measured["nees_mean"], abs=0.051)


def test_margins_are_as_their_episodes_say():
    document = json.loads((DOCS / "data/margin_trials.json").read_text())
    kept = {(str(row["seed"]), row["pilot"], row["cell"]): row["outcomes"] for row in document["rows"]}
    found = table("tuning.md", "## Smaller margins", "| seed | pilot |")
    shown = 0
    for seed, pilot, *cells in found:
        for cell, text in zip(document["cells"], cells, strict=True):
            own = kept.get((seed.strip(" |"), pilot, cell))
            if own is None:
                assert text.strip(" |") == "-"
                continue
            shown += 1
            before = kept.get((seed.strip(" |"), "as it was", cell))
            assert told(text.strip(" |")) == pytest.approx(rates(own), abs=0.051), (pilot, cell)
            if before is not None and pilot != "as it was":
                won, lost = paired(own, before)
                assert text.strip(" |").endswith(f"(+{won} -{lost})"), (pilot, cell)
    assert shown == len(kept)


@pytest.mark.parametrize(("column", "cell"), [(1, "pool15"), (2, "gaunt15")])
def test_trials_of_turns_are_as_their_episodes_say(column, cell):
    document = json.loads((DOCS / "data/turn_trials.json").read_text())
    kept = {}
    for row in document["rows"]:
        if row["cell"] == cell and row["seed"] != 77003:
            kept[row["pilot"]] = kept.get(row["pilot"], "") + row["outcomes"]
    for name, *cells in table("tuning.md", "## Turns that nobody", "| pilot |"):
        own, text = kept.get(name.strip(" |")), cells[column - 1].strip(" |")
        if own is None:
            assert text == "-"
            continue
        assert len(own) == 1200 and told(text) == pytest.approx(rates(own), abs=0.051), name
        won, lost = paired(own, kept["as it is"])
        assert won == 0 or text.endswith(f" (+{won} -{lost}, p = {mcnemar_p(won, lost):.2f})"), name


def outcomes_by_seed(document):
    """{(pilot, scene): {seed: outcomes}}"""
    kept = {}
    for row in document["rows"]:
        kept.setdefault((row["pilot"], document["cells"][row["cell"]]), {})[row["seed"]] = row["outcomes"]
    return kept


def check_paired_rows(found, kept, usual):
    """Rows (pilot, scene, seeds, rates of ``usual``, own rates with gains, losses and p) are as kept."""
    for name, scene, _seeds, was, text in ([cell.strip(" |") for cell in cells] for cells in found):
        own = kept[name, scene]
        before = "".join(kept[usual, scene][seed] for seed in own)
        outcomes = "".join(own.values())
        assert told(was) == pytest.approx(rates(before), abs=0.051), (name, scene)
        assert told(text) == pytest.approx(rates(outcomes), abs=0.051), (name, scene)
        won, lost = paired(outcomes, before)
        assert text.endswith(f" (+{won} -{lost}, p = {mcnemar_p(won, lost):.3f})"), (name, scene)


def test_trials_of_the_gaze_are_as_their_episodes_say():
    document = json.loads((DOCS / "data/gaze_trials.json").read_text())
    kept = outcomes_by_seed(document)
    found = table("tuning.md", "## Where the nose looks", "| pilot |")
    assert len(found) == len(kept)
    for cells in found:
        name, scene, seeds, text = (cell.strip(" |") for cell in cells)
        own, before = kept[name, scene], kept["as it was", scene]
        assert {seeds.split(" ")[0].strip(","), seeds.split(" ")[-1]} == {str(min(own)), str(max(own))}
        assert told(text) == pytest.approx(rates("".join(own.values())), abs=0.051), (name, scene)
        won, lost = paired("".join(own.values()), "".join(before[seed] for seed in own))
        assert name == "as it was" or text.endswith(f" (+{won} -{lost}, p = {mcnemar_p(won, lost):.3f})"), (
            name
        )


def test_trials_of_learnt_numbers_are_as_their_episodes_say():
    document = json.loads((DOCS / "data/number_trials.json").read_text())
    kept = outcomes_by_seed(document)
    found = table("tuning.md", "## Numbers that learning", "| pilot |")
    assert {(name.strip(" |"), scene) for name, scene, *_ in found} == {
        k for k in kept if k[0] != "as it was"
    }
    check_paired_rows(found, kept, "as it was")
    nominal = {}
    for row in document["nominal"]:
        nominal[row["pilot"]] = nominal.get(row["pilot"], "") + row["outcomes"]
    before, own = nominal.values()
    won, lost = paired(own, before)
    said = f"{own.count('s'):,} against {before.count('s'):,} of {len(own):,} episodes (+{won} -{lost})"
    assert said in " ".join((DOCS / "tuning.md").read_text().split())


def test_trials_of_bodies_that_leave_the_fan_are_as_their_episodes_say():
    document = json.loads((DOCS / "data/leaving_trials.json").read_text())
    kept = outcomes_by_seed(document)
    found = table("tuning.md", "## Bodies that leave", "| pilot |")
    assert len(found) == len(kept) - sum(name == "as it is" for name, _ in kept)
    check_paired_rows(found, kept, "as it is")
    for name, scene, seeds, *_ in found:
        assert seeds.strip(" |") == ", ".join(map(str, sorted(kept[name.strip(" |"), scene.strip(" |")])))
    failures, gaps = document["maze_failures"], document["unseen_vertical_gap_m"]
    unseen, late = (
        sum(failures[label] for label in labels)
        for labels in (("unseen_above", "unseen_below"), ("kept_away", "too_slow"))
    )
    said = " ".join((DOCS / "tuning.md").read_text().split())
    assert f"{sum(failures.values())} episodes of `maze`" in said and f"fail: {unseen} by a body" in said
    assert f"passes {gaps[0]:.2f} to {gaps[-1]:.2f} m" in said and f", {late} by time" in said
    assert f"(median {np.median(gaps):.2f} m" in said
    names, scene, new = ("a side is a part", "as it is"), "pool (8, 9, 1.5)", (77008, 77009)
    won, lost = paired(*("".join(kept[name, scene][seed] for seed in new) for name in names))
    assert f"had seen: +{won} -{lost})" in said


def test_what_forecasts_miss_is_as_counted():
    kept = json.loads((DOCS / "data/turn_trials.json").read_text())
    found = table("tuning.md", "## Turns that nobody", "| moments of tracks |")
    for (name, n, off), row in zip(found, kept["forecasts"], strict=True):
        assert (name.strip(" |"), n) == (row["moments"], f"{row['n']:,}")
        assert off.strip(" |") == f"{100 * row['off'] / row['n']:.0f} %"
    text = (DOCS / "tuning.md").read_text()
    for row in kept["danger"]:
        assert f"{row['collisions'] / row['seconds']:.3f}" in text


def test_local_planners_are_as_their_episodes_say():
    rows = json.loads((DOCS / "data/baselines_90001.json").read_text())["rows"]
    kept = {(row["method"], row["cell"]): row["outcomes"] for row in rows}
    names = ["pool (8, 6, 0.6)", "pool (8, 9, 1.5)", "gauntlet (8, 9, 1.5)"]
    found = table("baselines.md", "## What came out on seed 90001", "| | pool")
    assert len(found) * len(names) == len(kept)
    for method, *cells in found:
        for cell, name in zip(cells, names, strict=True):
            outcomes, tree = kept[method.strip("`"), name], kept["bt", name]
            assert told(cell.strip(" |")) == pytest.approx(rates(outcomes), abs=0.051), (method, name)
            if "p = " in cell:
                p = float(cell.split("p = ")[1].strip(" |"))
                assert p == pytest.approx(mcnemar_p(*paired(outcomes, tree)), rel=0.15, abs=0.006)


def test_turn_backs_are_as_their_counts_say():
    cells = json.loads((DOCS / "data/turn_backs.json").read_text())["cells"]
    rows = table("tuning.md", "### Are the futures", "| probability |")
    for row, *bins in zip(rows, *cells.values(), strict=True):
        for text, found in zip(row[1:3], bins, strict=True):
            of_body = found["moments"] - found["no_body"] - found["other_way"]
            mean, _, turned = text.strip(" |").partition("; ")
            if of_body == 0:
                assert mean == "-"
                continue
            assert float(mean) == pytest.approx(100 * found["mean_probability"], abs=0.051)
            assert turned == f"{100 * found['turned'] / of_body:.1f} of {of_body:,}"


@pytest.mark.parametrize(
    ("phase_m", "way", "came"),
    [
        (2.0, (1.5, 0.0), ("line", True, True)),  # 1 m before the end of its way
        (1.0, (1.5, 0.0), ("line", False, False)),  # 2 m before it
        (3.5, (1.5, 0.0), ("other way", False, False)),  # it has turned back already
    ],
)
def test_what_came_follows_from_the_path(phase_m, way, came):
    """A body that swims to and fro on 3 m at 1.5 m/s, looked at for 0.8 s; and where no body is."""
    path = {
        "shape": "polyline", "corners": [[0.0, 0.0], [3.0, 0.0]], "length_m": 6.0, "phase_m": phase_m,
        "speed_m_s": 1.5,
    }  # fmt: skip
    here = np.array([min(phase_m, 6.0 - phase_m), 0.0])
    assert what_came([{"path": path}], here, np.array(way), 0.0) == came
    assert what_came([{"path": path}], here + 0.6, np.array(way), 0.0) == ("none", False, False)


def test_scores_of_forecasts_are_whole():
    """Every cell judges every forecast, and every future of every moment is in a bin of the reliability."""
    kept = json.loads((DOCS / "data/forecasts.json").read_text())
    assert (DOCS / "forecasts.png").is_file()
    for cell in kept["cells"]:
        assert list(cell["methods"]) == ["constant velocity", "arcs and habits", "with turns back", "learned"]
        assert sum(row[2] for row in cell["reliability"]) == N_MODE * cell["moments"]
        came = sum(share * count for _mean, share, count in cell["reliability"])
        assert came == pytest.approx(cell["moments"], rel=1e-3), "one of the futures is the nearest"


def test_a_spread_that_is_fitted_is_the_errors_own():
    rng = np.random.default_rng(1)
    sigma = np.array([[0.2, 0.1], [0.5, 0.3]])
    place = torch.from_numpy(rng.normal(0, 1, (4000, 1, 2, 2))).float()
    truth = place[:, 0] + torch.from_numpy(rng.normal(0, 1, (4000, 2, 2)) * sigma).float()
    mixture = with_spread(torch.zeros(4000, 1), place, truth)
    assert len(mixture.place) == 2000
    np.testing.assert_allclose(mixture.sigma[0, 0].numpy(), sigma, rtol=0.08)
