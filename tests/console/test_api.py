"""The commands as functions: the same documents as theirs, shown as their tables."""

import json
import sys
import types
import webbrowser

import pytest

import uuvtai
from tests.command import uuv
from tests.small_sim import SmallSim
from uuvtai import api

HORIZON = 300
CHANGES = SmallSim.CHANGES | {"episode.horizon_steps": HORIZON}
SMALL = {"num_envs": SmallSim.N, "device": "cpu", "overrides": CHANGES}
OWN = '''"""Drives."""

def act(view):
    return 0.5 * view.limits * view["heading_error"][:, 1:]


class Plans:
    def plan(self, clearance, cell_m, start, goal, forecast):
        return [start, goal]


def same(inner):
    return [inner]


def late(view):
    return {"late": -0.125 * view.time_s}
'''


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(result, module of the user's) of a tree and a function beside it."""
    folder = tmp_path_factory.mktemp("api")
    (folder / "own.py").write_text(OWN)
    sys.path.insert(0, str(folder))
    import own  # type: ignore[import-not-found]

    sys.path.remove(str(folder))
    found = uuvtai.evaluate(
        ["straight", own.act], episodes=4, seeds=3, record=1, run_dir=folder / "run", **SMALL
    )
    return found, own


@pytest.fixture
def pandas(monkeypatch):
    """Stands for pandas: a frame is its rows."""
    monkeypatch.setitem(sys.modules, "pandas", types.SimpleNamespace(DataFrame=list))


def test_an_evaluation_is_that_of_the_command(run, capfd, tmp_path):
    typed = ["eval", "--agent", "straight", "--seeds", "3", "--episodes", "4", "--run-dir", tmp_path / "run"]
    horizon = f"episode.horizon_steps={HORIZON}"
    code, printed, _ = uuv(capfd, *typed, "--json", *SmallSim.OPTIONS, "--set", horizon)
    found = run[0]
    ours, theirs = found.document["agents"][0], json.loads(printed)["agents"][0]
    clock = ("wall_s", "env_steps_per_s")
    assert code == 0 and {k: v for k, v in ours.items() if k not in clock} == {
        k: v for k, v in theirs.items() if k not in clock
    }


def test_results_print_as_tables_in_a_terminal_and_in_a_notebook(run, monkeypatch):
    found = run[0]
    monkeypatch.setenv("COLUMNS", "80")
    assert max(map(len, str(found).splitlines())) <= 80
    assert (
        [table.rows for table in found.tables()] and "own-act" in str(found) and "to_pandas()" in str(found)
    )
    page = found._repr_html_()
    assert page.count("<table>") == 2 and "<td>own-act</td>" in page and str(found.folder) in repr(found)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)  # there Rich shows instead of writing
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert "own-act" in str(found) and "\x1b" not in str(found) and found._repr_html_() == page
    odd = api._html(found.tables()[0].__class__((), (), "<script>"))
    assert "<script>" not in odd and "&lt;script&gt;" in odd


def test_frames_have_a_row_an_agent_an_episode_and_a_message(run, pandas):
    found = run[0]
    agents, episodes = found.to_pandas(), found.to_pandas(episodes=True)
    assert [row["name"] for row in agents] == ["straight", "own-act"] and "outcomes.success" in agents[0]
    assert len(episodes) == 8 and {"agent", "seed", "episode", "outcome"} <= episodes[0].keys()
    log = uuvtai.load_log(found.logs[0])
    rows, messages = log.to_pandas("/sensors/imu"), list(log.messages("/sensors/imu"))
    assert len(rows) == len(messages) > 10 and rows[1]["time_s"] == messages[1].time_s
    assert "pose.position.x" in log.to_pandas("/pose")[0] and "/sensors/imu" in str(log)
    assert log._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(KeyError, match="no topic '/ego'; there are /tf"):
        log.to_pandas("/ego")


def test_without_pandas_it_says_what_to_install(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        run[0].to_pandas()


def test_show_opens_a_report_or_a_picture(run, monkeypatch):
    opened = []
    monkeypatch.setattr(webbrowser, "open_new_tab", opened.append)
    report, picture = uuvtai.show(run[0]), uuvtai.show(run[0].logs[0])
    assert report.read_text().startswith("<!DOCTYPE html>") and picture.read_bytes().startswith(b"\x89PNG")
    assert opened == [report.resolve().as_uri(), picture.resolve().as_uri()]


def test_functions_and_classes_of_a_file_are_agents_and_others_are_refused(run, tmp_path):
    own = run[1]
    assert api._named(own.Plans, "planner") == [f"planner:{own.__file__}:Plans"]
    assert api._named(tmp_path) == [str(tmp_path)] and api._named(run[0]) == [str(run[0].folder)]
    scope: dict = {}
    exec("def typed(view): ...", scope)  # as in a notebook's cell
    for wrong in (scope["typed"], lambda view: view, own.Plans(), len, 3):
        with pytest.raises(ValueError, match=r"write it to one .*mine\.py:NAME"):
            uuvtai.evaluate(wrong)


def test_bad_input_is_refused_as_by_the_command(tmp_path):
    for error, words in (
        ("episodes=0: .* at least 1", {"episodes": 0}),
        ("episodes='8': must be a whole number", {"episodes": "8"}),
        ("episodes=True: must be", {"episodes": True}),
        ("num_envs=1.5: must be a whole", {"num_envs": 1.5}),
        ("record=-1: .* at least 0", {"record": -1}),
        ("seeds=0: .* at least 1", {"seeds": []}),
        ("agents=0: .* at least 1", {"agents": []}),
        ("negative", {"seeds": -1}),
        ("given twice", {"seeds": [1, 1]}),
        ("did you mean 'pool'", {"world": "poool"}),
        ("no such file", {"world": tmp_path / "nowhere.yaml"}),
        ("n_dynamc", {"overrides": {"world.n_dynamc": 3}}),
    ):
        with pytest.raises(ValueError, match=error):
            uuvtai.evaluate(**{"agents": "straight"} | words)
    for error, grid, words in (
        ("axis", {"nothing": [1]}, {}),
        ("episodes=0", {"D": 3}, {"episodes": 0}),
        ("workers=0", {"D": 3}, {"workers": 0}),
        ("'poool' is no world preset", {"world": "poool"}, {}),
    ):
        with pytest.raises(ValueError, match=error):
            uuvtai.sweep("straight", grid, **words)
    with pytest.raises(AttributeError, match="nowhere"):
        uuvtai.nowhere()
    assert {"evaluate", "train", "make"} <= set(dir(uuvtai))


class Here:
    """An engine that needs no other process."""

    def run(self, work, items):
        yield from enumerate(map(work, items))


def test_a_sweep_and_a_training_are_those_of_the_commands(run, tmp_path, pandas, monkeypatch):
    monkeypatch.setattr("uuvtai.evaluation.sweep.engine_of", lambda *_asked: Here())
    cells = uuvtai.sweep("straight", {"D": [0, 9]}, episodes=2, run_dir=tmp_path / "sweep", **SMALL)
    assert api._several(3) == [3] and api._several((1, 2)) == [1, 2]
    assert [row["D"] for row in cells.to_pandas()] == [0, 9] and "2 cells x 2 episodes" in str(cells)
    few = CHANGES | {"train.num_envs": 8, "distillation.batch": 32, "world_model.batch": 32}
    first = uuvtai.train(
        "smoke", seed=1, iterations=1, overrides=few, device="cpu", run_dir=tmp_path / "train"
    )
    reward = run[1].late
    with pytest.raises(ValueError, match="began with no --reward"):
        uuvtai.train(resume=first, iterations=2, device="cpu", reward=reward)
    again = uuvtai.train(resume=first, iterations=2, device="cpu")
    assert [row["iteration"] for row in again.to_pandas()] == [1, 2]
    own = uuvtai.train(
        "smoke", iterations=1, overrides=few, device="cpu", run_dir=tmp_path / "own", reward=reward
    )
    assert own.to_pandas()[0]["reward/late"] < 0.0
    assert f"next:uuveval--agent{first.folder}" in "".join(str(again).split())
