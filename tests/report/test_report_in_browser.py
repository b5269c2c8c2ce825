"""The report in a real browser, from disk: no overflow, no failure, no request, light and dark."""

import cv2
import numpy as np
import pytest

from tests import report_samples as samples
from tests.browser import VIEWS, brightness, look
from tests.oracles.logs import record
from uuvtai.evaluation.results import paired
from uuvtai.report.build import report

BAD = """<!DOCTYPE html><title>bad</title><div id="a" style="width: 3000px">wide</div><p id="a"></p>
<img src="http://uuvtai.invalid/picture.png"><script>throw new Error("broken")</script>"""
"""What the check must find fault with"""


AXES = {"S": [4, 8], "D": [0, 15], "v_m_s": [0.2, 0.6, 3.0]}
REWARDS = [
    {name: row[name] for name in ("iteration", "time/env_steps", "rollout/ep_rew_mean")}
    for row in samples.metrics(12)
]


def picture(path):
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), np.full((300, 1600, 3), 200, np.uint8))


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A page with everything that a report can hold, with long names."""
    folder = tmp_path_factory.mktemp("browser") / "run"
    long = "a_method_with_a_name_that_is_far_longer_than_any_column_would_like_it_to_be"
    agents = [samples.agent(long, causes=[samples.CAUSE], explain=[1, 2]), samples.agent("bt")]
    verdict = {"claim": "it swims " * 30, "verdict": "holds", "numbers": "3 of 3"}
    blocks = [
        {"kind": "verdicts", "items": [verdict]},
        {"kind": "curves", "paths": ["t_0", "t_1"]},
        {"kind": "run", "path": "noise"},
    ]
    document = {"schema": 1, "title": "Everything", "sections": [{"title": "First", "blocks": blocks}]}
    result = samples.evaluation_document(*agents) | {"paired": paired(agents)}
    samples.write_run(
        folder, ("uuv", "eval", "x" * 300), "key: " + "y" * 500, reproduce=document, eval__result=result,
        sweep=samples.sweep_document(axes=AXES), profile=samples.PROFILE,
    )  # fmt: skip
    samples.write_run(folder / "noise", sweep=samples.noise_sweep())
    for i in range(2):
        samples.write_run(folder / f"t_{i}", config=f"train:\n  seed: {i}\n", metrics=REWARDS)
    picture(folder / "pictures/seed0_episode0.png")
    (folder / "logs").mkdir()
    record(folder / "logs/bt_seed0_episode7.mcap", 60)
    return report([folder]).page


@pytest.fixture(scope="module")
def seen(page, tmp_path_factory):
    """What the browser met in the page and in one that is wrong in every way, by (is good, width, scheme)."""
    bad = tmp_path_factory.mktemp("bad") / "bad.html"
    bad.write_text(BAD)
    return {(name == str(page), *view): one for (name, *view), one in look(page, bad).items()}


@pytest.mark.parametrize(("width", "scheme"), VIEWS)
def test_a_report_is_whole_and_quiet_in_every_view(seen, width, scheme):
    found = seen[True, width, scheme]
    assert found["errors"] == [] and found["requests"] == []
    for folds in ("closed", "open"):
        assert found[folds]["innerWidth"] == width
        assert found[folds]["scrollWidth"] <= width, f"the page overflows with its details {folds}"
    there = found["open"]
    assert there["title"] == "Everything"
    assert [there[name] for name in ("images", "scripts", "doubleIds", "deadLinks")] == [1, 1, [], 0]
    assert there["svgs"] > 6 and there["hovers"] > 50 and there["downloads"] > 5


def test_figures_follow_light_and_dark(seen):
    light, dark = (seen[True, 390, scheme]["open"] for scheme in ("light", "dark"))
    assert brightness(light["background"]) > 700 > 100 > brightness(dark["background"])
    assert brightness(light["ink"]) < 200 < 600 < brightness(dark["ink"])
    assert light["inkedTexts"] == dark["inkedTexts"] > 50, "text of the figures has the page's colour in both"


def test_a_dark_screen_prints_black_on_white(seen):
    printed = seen[True, 1400, "dark"]["printed"]
    assert brightness(printed["background"]) > 700 and brightness(printed["ink"]) < 200
    assert printed["scrollWidth"] <= 1400


def test_the_check_finds_fault_with_a_bad_page(seen):
    found = seen[False, 390, "light"]
    assert found["closed"]["scrollWidth"] == pytest.approx(3000, abs=20)
    assert any("broken" in error for error in found["errors"])
    assert found["requests"] == ["http://uuvtai.invalid/picture.png"]
    assert found["closed"]["doubleIds"] == ["a"] and found["closed"]["scripts"] == 1
