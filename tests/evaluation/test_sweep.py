"""Sweeps: cells, tasks, engines that lose workers, and folders that survive a kill at any moment."""

import json
import subprocess
import sys
import time

import pytest

from tests import worker_work
from tests.command import Quiet, uuv
from tests.report_samples import robustness_sweep
from tests.small_sim import SmallSim
from uuvtai.common.processes import EngineError
from uuvtai.config.loader import ConfigError
from uuvtai.console.screen import Screen
from uuvtai.console.views import show_sweep
from uuvtai.evaluation import sweep as sweep_run
from uuvtai.evaluation.episodes import Job, run_episodes
from uuvtai.evaluation.grid import Grid, SweepRequest, base_config, grid_of, request_of, tasks_of
from uuvtai.evaluation.sweep import ROWS, RayEngine, read_rows, resume, sweep
from uuvtai.logs.run_folder import RunFolderError

# ------------------------------------------------------------------------------------------------------- grid


def test_the_papers_grid_shares_what_does_not_move():
    cells = grid_of(["paper"]).cells()
    assert len(cells) == 3 * (1 + 4 * 6)
    assert sum(cell["D"] == 0 for cell in cells) == 3
    assert all(("v" in cell) == (cell["D"] > 0) for cell in cells)
    assert grid_of([]) == grid_of(["paper"])


def test_axes_are_read_as_typed():
    grid = grid_of(
        ["S=4,8", "behavior.caution=0.5,1", "disturbance.current_m_s=[0.1,0,0]", "sensors=paper,harsh"]
    )
    assert grid.axes == {
        "S": (4, 8), "behavior.caution": (0.5, 1), "disturbance.current_m_s": ([0.1, 0, 0],),
        "sensors": ("paper", "harsh"),
    }  # fmt: skip
    assert len(grid.cells()) == 8


def test_typed_axes_replace_those_of_the_preset():
    grid = grid_of(["paper", "S=8", "v=0.6"])
    assert (grid.axes["S"], grid.axes["D"], grid.axes["v"]) == ((8,), (0, 3, 6, 9, 15), (0.6,))


def test_one_at_a_time_varies_each_axis_around_the_condition():
    grid = Grid({"D": (3, 9), "sensors": ("harsh",)}, one_at_a_time=True)
    assert grid.cells() == [{}, {"D": 3}, {"D": 9}, {"sensors": "harsh"}]


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (["Q=1"], "no such axis"),
        (["S="], "has no values"),
        (["S=4,4"], "given twice"),
        (["S=4", "S=8"], "an axis is given twice"),
        (["S=-1"], "no number of obstacles"),
        (["D=1.5"], "no number of obstacles"),
        (["v=fast"], "no speed"),
        (["v=.inf"], "no speed"),
        (["sensors=sharp"], "no sensors preset; there are 3d15"),
        (["S=[1"], "not valid YAML"),
        (["nosuch"], "nosuch"),
        (["paper", "caution"], "one preset at most"),
        (
            [
                "world.n_static=" + ",".join(map(str, range(200))),
                "world.n_dynamic=" + ",".join(map(str, range(200))),
            ],
            "split it",
        ),
    ],
)
def test_grids_that_cannot_be_are_refused(texts, said):
    with pytest.raises(ConfigError, match=said):
        grid_of(texts)


def test_a_grid_file_says_what_is_wrong(tmp_path):
    file = tmp_path / "g.yaml"
    for text, said in [
        ("axes: {S: 4}", "each a list"),
        ("axis: {S: [4]}", "axis is not known"),
        ("{}", "is empty"),
        ("what: a grid", "needs 'axes:'"),
    ]:
        file.write_text(text)
        with pytest.raises(ConfigError, match=said):
            grid_of([str(file)])


@pytest.mark.parametrize("name", ["paper", "benchmark", "caution", "robustness", "dead_reckoning"])
def test_shipped_grids_load_and_every_cell_has_a_config(name):
    request = asked(grid_of([name]))
    tasks = tasks_of(request, [("bt", "bt")], set())
    assert sum(len(task.labels) for task in tasks) == len(request.grid.cells())


# ------------------------------------------------------------------------------------------------------ tasks


def asked(grid, **changes):
    given = {
        "grid": grid, "world": "pool", "sensors": None, "vehicle": None, "overrides": (),
        "agents": ("bt",),
        "seeds": (3,), "episodes": 4,
    }  # fmt: skip
    return SweepRequest(**(given | changes))


def test_one_simulator_serves_every_scene():
    tasks = tasks_of(asked(grid_of(["paper"]), episodes=64), [("bt", "bt"), ("straight", "straight")], set())
    assert len({task.config.model_dump_json() for task in tasks}) == 1
    assert (tasks[0].config.world.static_slots, tasks[0].config.world.dynamic_slots) == (16, 16)
    assert all(64 * len(task.scenes) <= 1024 for task in tasks)
    labels = [label for task in tasks for label in task.labels]
    assert len(labels) == 2 * 75
    assert labels[0] == {"S": 4, "D": 0, "v_m_s": None}


def test_other_axes_make_configs_of_their_own():
    tasks = tasks_of(asked(grid_of(["behavior.caution=0.5,2", "D=0,6"])), [("bt", "bt")], set())
    assert [task.config.behavior.caution for task in tasks] == [0.5, 2.0]
    assert tasks[1].labels == (
        {"S": 8, "D": 0, "v_m_s": None, "behavior.caution": 2},
        {"S": 8, "D": 6, "v_m_s": 0.6, "behavior.caution": 2},
    )


def test_one_axis_at_a_time_tells_what_is_unchanged(tmp_path):
    grid = Grid(
        {"D": (3,), "sensors": ("harsh",), "disturbance.current_m_s": ([0.1, 0.0, 0.0],)}, one_at_a_time=True
    )
    document, folder = sweep(asked(grid), Canned(), tmp_path / "run", Quiet())
    assert document["one_at_a_time"]
    assert document["unchanged"] == {"D": 6, "sensors": None, "disturbance.current_m_s": [0.0, 0.0, 0.0]}
    assert json.loads((folder / "sweep.json").read_text())["unchanged"] == document["unchanged"]


def test_what_is_printed_of_one_axis_at_a_time_names_what_changes(capsys):
    show_sweep(Screen(), robustness_sweep())
    lines = capsys.readouterr().out.splitlines()
    assert sum("nothing" in line for line in lines) == 2
    assert any("sensors = harsh" in line and "best" in line and "11/16" in line for line in lines)


def test_a_request_survives_its_json():
    request = asked(
        grid_of(["S=4,8", "behavior.caution=0.5,1"]),
        overrides=("world.n_dynamic=3", ("observation", {"n_track": 4})),
    )
    assert request_of(json.loads(json.dumps(request.document()))) == request


def test_wrong_keys_are_refused_before_anything_is_written(tmp_path):
    place = tmp_path / "run"
    with pytest.raises(ConfigError, match="did you mean 'caution'"):
        sweep(asked(Grid({"behavior.cautoin": (1, 2)})), Canned(), place, Quiet())
    with pytest.raises(ConfigError, match="same cell twice"):
        sweep(asked(Grid({"D": (6,)}, one_at_a_time=True)), Canned(), place, Quiet())
    assert not place.exists()


def test_an_axis_that_a_stack_sets_itself_is_told():
    watch, grid = Quiet(), Grid({"D": (0, 6), "behavior.slow_fraction": (0.4, 0.5)})
    sweep_run.resolved(asked(grid, agents=("best", "bt")), watch)
    assert watch.answer == [
        "note: best: its stack has behavior.slow_fraction = 1.0, not 0.4; write a stack that 'extends: best'"
    ]


# ----------------------------------------------------------------------------------------------------- folder


def row(label, agent):
    return {**label, "agent": agent, "success_rate": 0.5, "told": label["S"] + label["D"]}


class Canned:
    """An engine that knows the rows already and stops after some tasks as if killed, or by Ctrl-C."""

    def __init__(self, stop_after=None, error=KeyboardInterrupt):
        self.stop_after, self.error, self.ran = stop_after, error, []

    def run(self, work, items):
        for number, task in enumerate(items):
            if self.stop_after is not None and len(self.ran) >= self.stop_after:
                raise self.error
            self.ran.append(task)
            yield number, [row(label, task.agent) for label in task.labels]


GRID = grid_of(["S=4,8,12", "D=0,6", "v=0.4,0.6"])


def test_an_interrupted_sweep_goes_on_where_it_was(tmp_path):
    request = asked(GRID, episodes=300)  # three cells a task
    whole, _ = sweep(request, Canned(), tmp_path / "whole", Quiet())
    place, watch = tmp_path / "cut", Quiet()
    with pytest.raises(KeyboardInterrupt):
        sweep(request, Canned(stop_after=1), place, watch)
    assert any(f"--resume {place}" in text for text in watch.answer)
    assert json.loads((place / "run.json").read_text())["status"] == "interrupted"
    rest = Canned()
    assert resume(place, rest, Quiet())[0] == whole
    assert sum(len(task.labels) for task in rest.ran) == 9 - 3
    again = Canned()
    assert resume(place, again, Quiet())[0] == whole
    assert again.ran == []


@pytest.mark.parametrize("cut", [1, 5, 60])
def test_a_line_cut_off_by_a_kill_is_played_again(tmp_path, cut):
    request, place = asked(GRID, episodes=300), tmp_path / "run"
    whole, _ = sweep(request, Canned(), place, Quiet())
    file = place / ROWS
    file.write_bytes(file.read_bytes()[:-cut])
    rest = Canned()
    assert resume(place, rest, Quiet())[0] == whole
    assert [len(task.labels) for task in rest.ran] == [1]
    assert len(read_rows(place)) == 9


def test_a_policy_that_was_trained_on_is_refused(tmp_path):
    place = tmp_path / "run"
    sweep(asked(GRID), Canned(), place, Quiet())
    file = place / "sweep_request.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"checkpoints": {"mine": "0" * 64}}))
    with pytest.raises(RunFolderError, match="mine has changed since this sweep began"):
        resume(place, Canned(), Quiet())


def test_only_a_sweeps_folder_is_resumed(tmp_path):
    with pytest.raises(RunFolderError, match="give the folder that 'uuv sweep' printed"):
        resume(tmp_path, Canned(), Quiet())
    sweep(asked(GRID), Canned(), tmp_path / "old", Quiet())
    file = tmp_path / "old/sweep_request.json"
    old = json.loads(file.read_text())
    del old["named_agents"]
    file.write_text(json.dumps(old | {"controllers": ["bt"], "policies": []}))
    with pytest.raises(RunFolderError, match="an older version of uuv wrote it; begin the sweep again"):
        resume(tmp_path / "old", Canned(), Quiet())


def test_two_processes_do_not_share_a_sweep(tmp_path, monkeypatch):
    place = tmp_path / "run"
    sweep(asked(GRID), Canned(), place, Quiet())

    class Nosy(Canned):
        def run(self, work, items):
            with pytest.raises(RunFolderError, match="another process"):
                resume(place, Canned(), Quiet())
            yield from super().run(work, items)

    assert resume(place, Nosy(), Quiet())[0]["cells"]


# ---------------------------------------------------------------------------------------------------- engines


def test_a_ray_cluster_gives_the_same_results_and_runs_lost_tasks_again(tmp_path):
    ray = pytest.importorskip("ray", reason="the extra [cluster] is not installed")
    engine = RayEngine("local", cpus_per_task=1)
    assert list(engine.run(worker_work.fall_once, [str(tmp_path / "a")])) == [(0, "a")]
    assert sorted(engine.run(worker_work.square, [3, 1, 2])) == [(0, 9), (1, 1), (2, 4)]
    with pytest.raises(ValueError, match="-2 is negative"):
        list(engine.run(worker_work.square, [-2]))
    ray.shutdown()


def test_without_ray_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(EngineError, match="uuvtai\\[cluster\\]"):
        RayEngine()


# --------------------------------------------------------------------------------------------- the real thing

HORIZON_S = 8.0
OPTIONS = [*SmallSim.OPTIONS, "--set", "episode.horizon_steps=400", "-S", "4", "--episodes", "4", "--json"]


def test_a_killed_sweep_gives_what_an_evaluation_gives(small, tmp_path, capfd):
    """To the last digit, also after SIGKILL."""
    place = tmp_path / "sweep"
    command = ["sweep", "--grid", "D=2,6", "--grid", "v=1.5", "--agent", "bt", *OPTIONS]
    child = subprocess.Popen(
        [sys.executable, "-m", "uuvtai", *command, "--run-dir", str(place)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while not (place / sweep_run.REQUEST).exists():
        assert child.poll() is None, "ended before it had begun"
        time.sleep(0.02)
    child.kill()
    child.wait()
    code, out, err = uuv(capfd, "sweep", "--resume", place, "--json")
    assert code == 0, err
    cells = json.loads(out)["cells"]
    assert [(cell["D"], cell["v_m_s"]) for cell in cells] == [(2, 1.5), (6, 1.5)]
    results, _ = run_episodes(small.sim, [Job(0, episode, (4, 2, 1.5)) for episode in range(4)])
    small.sim.set_scenes()
    ours = [(r.outcome, r.time_s) for r in results if r.time_s <= HORIZON_S]
    theirs = list(zip(cells[0]["episode_outcomes"], cells[0]["episode_times_s"], strict=True))
    assert ours == [end for end in theirs if end[0] != "timeout"]
    assert ours, "or nothing was compared"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--grid", "Q=1"], "no such axis"),
        (["--engine", "slurm"], "local or ray"),
        (["--workers", "0"], "at least 1"),
        (["--resume", "/nosuch"], "give the folder that 'uuv sweep' printed"),
        (["--resume", "x", "--grid", "S=4"], "a resumed run keeps its own"),
        (["nosuch"], "extra argument(s) (nosuch); now it is --agent NAME|FILE"),
        (["--agent", "nosuch"], "nosuch"),
    ],
)
def test_bad_input_is_one_message_and_no_folder(arguments, said, tmp_path, capfd):
    place = tmp_path / "run"
    where = [] if "--resume" in arguments else ["--run-dir", place]
    code, _out, err = uuv(capfd, "sweep", *arguments, *where)
    assert code in (1, 2)
    assert said in " ".join(err.split())
    assert "Traceback" not in err
    assert not place.exists()


def test_base_config_has_room_for_the_largest_cell():
    config = base_config(asked(grid_of(["S=4,18", "D=3"]), overrides=("world.n_dynamic=9",)))
    assert (config.world.static_slots, config.world.dynamic_slots) == (18, 16)
