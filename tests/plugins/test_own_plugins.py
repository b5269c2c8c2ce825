"""Plugins that the user brings: found, called once per decision, checked, and refused by file and line."""

import json
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.command import uuv
from tests.evaluation.test_resume_eval import Watch
from tests.sim.test_observation_only import KNOWN, Poison
from uuvtai.common.errors import SettingError, UserError
from uuvtai.config import Config, ObservationConfig
from uuvtai.config.loader import ConfigError, load_training
from uuvtai.console import parsing
from uuvtai.console.groups import SceneGroup
from uuvtai.envs.vector_env import VectorEnv
from uuvtai.evaluation.agents import load_agents
from uuvtai.evaluation.episodes import Job, Stepper, jobs_of, run_episodes
from uuvtai.evaluation.evaluate import Request, compare, resume
from uuvtai.evaluation.failure_causes import FailureRecorder
from uuvtai.evaluation.grid import SweepRequest, base_config, grid_of, request_of
from uuvtai.evaluation.reproduce_steps import BUDGETS, steps_of
from uuvtai.kernels.planning.observation import observation_width
from uuvtai.learning import runner
from uuvtai.logs.run_folder import RunFolderError
from uuvtai.plugins import adapters, loading, plugin
from uuvtai.plugins.adapters import CallMeter
from uuvtai.plugins.api import COMMAND, PluginError, PluginSpec, is_plugin, plugin_spec, to_resume
from uuvtai.report.evaluation import agents_table
from uuvtai.report.tables import TERMINAL
from uuvtai.sim.setup import array_sizes
from uuvtai.surrogate.world import draw_bank

AWAY = "import numpy as np\n\ndef act(view):\n    return np.tile([0.6, 0.0, 0.0, 0.0], (len(view.rows), 1))\n"
N_OBS = observation_width(ObservationConfig())
AHEAD = "def plan(clearance, cell_m, start, goal, forecast):\n    return [start, goal]\n"


@pytest.fixture
def write(tmp_path, monkeypatch):
    """A function that writes a file of the user's into the folder where she works; its name."""
    monkeypatch.chdir(tmp_path)

    def written(text, name="mine.py"):
        (tmp_path / name).write_text(text)
        return name

    return written


@pytest.fixture
def sim(small):
    """The session's simulator, left as it was."""
    small.sim.use_tree(small.trees["bt"])
    observed = small.sim.observation
    yield small.sim
    small.sim.planner, small.sim.observation = None, observed
    small.sim.use_tree(small.trees["bt"])


def found(text, kind="controller"):
    return loading.load_plugin(plugin_spec(text, kind))


def stepped(sim, text, steps=3, kind="controller", rows=None):
    """The agent after a few steps of all rows."""
    agent = found(text, kind).agent(sim)
    stepper = Stepper(sim, agent)
    mask = torch.ones(sim.num_envs, dtype=torch.int32)
    stepper.reset(mask, torch.full_like(mask, 77), torch.arange(sim.num_envs, dtype=torch.int32))
    for _ in range(steps):
        stepper.step()
    return agent


# ------------------------------------------------------------------------------------------------------ names


@pytest.mark.parametrize(
    ("text", "kind", "answer"),
    [
        ("a/mine.py:act", "controller", ("controller:a/mine.py:act", "mine-act", True)),
        ("mine.py", "planner", ("planner:mine.py:plan", "mine-plan", True)),
        ("mine.py:load=runs/sb3", "policy", ("policy:mine.py:load=runs/sb3", "mine-sb3", True)),
        ("my model.onnx", "policy", ("policy:my model.onnx", "my_model", False)),
        ("planner:mine.py:plan", "controller", ("planner:mine.py:plan", "mine-plan", True)),
    ],
)
def test_a_piece_has_a_name_that_finds_it_again(text, kind, answer):
    spec = plugin_spec(text, kind)
    assert (spec.text, spec.label, spec.is_code) == answer
    assert plugin_spec(spec.text) == spec and is_plugin(spec.text)


@pytest.mark.parametrize("text", ["bt", "mine.xml", "best", "runs/first", "bt+truth", "ours.yaml"])
def test_what_is_no_piece_stays_what_it_was(text):
    assert not is_plugin(text)


@pytest.mark.parametrize(
    ("text", "kind", "says"),
    [
        ("mine", "planner", "--planner 'mine': names no plugin; for example --planner mine.py:plan"),
        ("mine.py:1x", "controller", "'1x' is no name of Python"),
        ("model.onnx", "controller", "names no plugin; for example --agent mine.py:act"),
        ("policy:model.pt", "controller", "--agent 'model.pt': names no plugin"),
    ],
)
def test_a_name_that_names_nothing_is_refused(text, kind, says):
    with pytest.raises(SettingError, match=says.replace("(", r"\(")):
        plugin_spec(text, kind)


def test_options_become_names_of_agents():
    typed = ["bt,mine.py:act", "best,bt", "m.onnx", "q.py:load=a,b", "q.py", "runs/first"]
    assert parsing.agents(typed, ["p.py"], ["bt"]) == [
        "bt", "controller:mine.py:act", "best", "policy:m.onnx", "policy:q.py:load=a,b",
        "controller:q.py:act", "runs/first", "planner:p.py:plan",
    ]  # fmt: skip
    assert parsing.agents(["policy:q.py:net"], None, []) == ["policy:q.py:net"]
    assert parsing.agents(None, ["p.py"], ["bt"]) == ["planner:p.py:plan"]
    assert parsing.agents(None, None, ["straight", "bt"]) == ["straight", "bt"]
    assert parsing.named_plugins(None, ["p.py"]) == ["planner:p.py:plan"]
    assert parsing.named_plugins(None, None) == [] and parsing.one_agent(None, None) is None
    assert parsing.one_agent("mine.py", None) == "controller:mine.py:act"
    for given in (("bt", ["p.py"]), (None, ["p.py", "q.py"]), ("bt,best", None)):
        with pytest.raises(parsing.UsageError, match="give one of them"):
            parsing.one_agent(*given)
    with pytest.raises(parsing.UsageError, match="bt: is no plugin of yours"):
        parsing.named_plugins(["bt"], None)
    with pytest.raises(parsing.UsageError, match="name who drives"):
        parsing.agents([","], None, ["bt"])


def test_two_rows_never_share_a_name(write):
    write(AWAY)
    Path("other").mkdir()
    write(AWAY, "other/mine.py")
    with pytest.raises(ConfigError, match="two rows would be called mine-act"):
        load_agents(["controller:mine.py:act", "controller:other/mine.py:act"])


# ---------------------------------------------------------------------------------------------------- loading


@pytest.mark.parametrize(
    ("text", "name", "says"),
    [
        (None, "mine.py:act", "mine.py cannot be read (No such file or directory)"),
        ("def act(view:\n", "mine.py:act", "mine.py:1: SyntaxError"),
        ("x = 1\nprint(y)\n", "mine.py:act", "mine.py:2: NameError: name 'y' is not defined (while --agent"),
        (
            "import uuvtai\nuuvtai.evaluate('mine.py:act')\n",
            "mine.py:act",
            "mine.py: runs itself again; move all but imports, functions and classes below",
        ),
        ("raise SystemExit(3)\n", "mine.py:act", "mine.py:1: SystemExit: 3"),
        ("def drive(view): ...\n", "mine.py:act", "mine.py has no 'act'; it has drive"),
        (
            "x = 3\n",
            "mine.py:x",
            "x is int, which cannot be called and has no act; a controller is called act(view)",
        ),
        (
            "\n\ndef act(a, b): ...\n",
            "mine.py:act",
            "mine.py:3: missing a required argument: 'b'; a controller is",
        ),
        (
            "def load(a, b): ...\n",
            "mine.py:load",
            "mine.py:1: load needs 2 arguments; it gets one (about) or none",
        ),
        ("class A:\n    def __init__(self):\n        1 / 0\n", "mine.py:A", "mine.py:3: ZeroDivisionError"),
        ("def act(v): ...\nact.rows = 'two'\n", "mine.py:act", "mine.py:1: act: rows is 'batch' or 'one'"),
        (
            "def act(v): ...\nact.hold_steps = 0\n",
            "mine.py:act",
            "hold_steps is a number of control steps from 1",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_by_its_line(sim, write, text, name, says):
    if text is not None:
        write(text)
    with pytest.raises(PluginError) as refused:
        found(name).agent(sim)
    assert says in str(refused.value) and "\n" not in str(refused.value)


def test_a_folder_is_no_file_of_python(tmp_path, monkeypatch):
    (tmp_path / "mine.py").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"mine.py: is a folder; give a plain file"):
        found("mine.py:act")


def test_a_class_and_load_are_made_once_and_told_what_is_known(sim, write):
    write(
        "import numpy as np\n"
        "class Pilot:\n"
        "    def __init__(self, about):\n"
        "        self.about, self.seen = about, []\n"
        "    def act(self, view):\n"
        "        return np.tile(self.about.limits, (len(view.rows), 1))\n"
        "def load(about=None):\n"
        "    return Pilot(about)\n"
    )
    for name in ("Pilot", "load=text"):
        agent = stepped(sim, f"mine.py:{name}", steps=1)
        about = agent.code.act.__self__.about
        assert (about.num_envs, about.n_obs, about.argument) == (8, N_OBS, "text" if "=" in name else "")
        assert torch.equal(agent.decision.action, torch.ones(8, 4)), "the limits are full speed"


def test_what_lies_beside_the_file_can_be_imported_and_no_bytecode_is_left(sim, write):
    write("GAIN = 0.5\n", "beside_mine.py")
    write("from beside_mine import GAIN\ndef act(view):\n    return [[GAIN, 0, 0, 0]] * len(view.rows)\n")
    assert float(stepped(sim, "mine.py").decision.action[3, 0]) == pytest.approx(0.5 / 0.6)
    assert not [path for path in Path().rglob("*.pyc") if "mine." in path.name and "beside" not in path.name]


# ----------------------------------------------------------------------------------------------------- asking

COUNTING = """
import numpy as np
from uuvtai.plugins import plugin
asked, begun = [], []
@plugin(rows={rows!r}, arrays={arrays!r}, hold_steps={hold})
def act(view):
    asked.append((np.atleast_1d(view.rows).tolist(), float(np.max(np.asarray(view.time_s)))))
    {assertion}
    return {answer}
def reset(rows):
    begun.append(rows.tolist())
"""
BATCH = {
    "rows": "batch",
    "arrays": "numpy",
    "answer": "np.tile([0.6, 0.0, 0.0, 0.0], (len(view.rows), 1))",
    "assertion": "",
}


def counting(write, **changes):
    write(COUNTING.format(**{"hold": 1} | BATCH | changes))
    return found("mine.py:act")


def test_each_running_row_is_asked_once_per_decision_and_told_of_its_episodes(sim, write):
    own = counting(write)
    agent = own.agent(sim)
    results, _steps = run_episodes(sim, jobs_of([77], 9), agent=agent)
    module = own.found.__globals__
    assert [len(rows) for rows, _t in module["asked"]][:3] == [8, 8, 8]
    calls = sum(len(rows) for rows, _t in module["asked"])
    # of every episode the observation after reset and after each step but, where rows rest, the last one
    steps = sum(round(r.time_s / 0.02) for r in results)
    assert steps <= calls <= steps + 2 * len(results)
    assert sorted(row for rows in module["begun"] for row in rows) == sorted(
        [*range(8), module["begun"][1][0]]
    )
    assert agent.code.meter.document()["calls"] == len(module["asked"])


def test_a_decision_is_held(sim, write):
    own = counting(write, hold=10)
    stepper = Stepper(sim, own.agent(sim))
    mask = torch.ones(8, dtype=torch.int32)
    stepper.reset(mask, mask, torch.arange(8, dtype=torch.int32))
    for _ in range(25):
        stepper.step()
    assert [time_s for _rows, time_s in own.found.__globals__["asked"]] == pytest.approx([0.0, 0.2, 0.4])


def test_one_by_one_and_torch_give_what_the_batch_gives(sim, write):
    parts = "v.obs[..., 0] * 0 + 0.3, v.goal[..., 0] * 0, v.ego.depth * 0 + 0.1, v.ego.rpy[..., 2] * 0.1"
    rule = f"np.stack([{parts}], -1)"
    write(
        "import numpy as np\nimport torch\nfrom uuvtai.plugins import plugin\n"
        f"def batch(v):\n    return {rule}\n"
        "@plugin(rows='one')\ndef one(v):\n    assert v.scan.range_m.ndim == 1 and isinstance(v.rows, int)\n"
        f"    return {rule}\n"
        "@plugin(arrays='torch')\ndef tensors(v):\n"
        "    assert all(isinstance(x, torch.Tensor) for x in (v.obs, v.goal, v.map.static, v.limits))\n"
        f"    return {rule.replace('np', 'torch')}\n"
    )
    batch, one, tensors = (
        stepped(sim, f"mine.py:{name}").decision.action for name in ("batch", "one", "tensors")
    )
    assert batch.abs().max() > 0.1
    assert torch.equal(batch, one) and torch.allclose(batch, tensors, atol=1e-6)


def test_a_policy_sees_chunks_of_one_size_and_acts_in_parts_of_the_limits(sim, write):
    write(
        "import torch\nshapes = []\n"
        "class Net(torch.nn.Module):\n"
        "    def forward(self, obs):\n"
        "        shapes.append(tuple(obs.shape))\n"
        "        return 5.0 * torch.ones(len(obs), 4)\n"
        "class Theirs:\n"
        "    def predict(self, obs, state=None, deterministic=False):\n"
        "        assert deterministic\n"
        "        return obs[:, :4] * 0 + 0.25, None\n"
        "def load():\n    return Net()\n"
    )
    own = found("mine.py:load", "policy")
    agent = own.agent(sim)
    assert agent.code.marks.arrays == "torch"
    stepper = Stepper(sim, agent)
    mask = torch.ones(8, dtype=torch.int32)
    stepper.reset(mask, mask, mask)
    assert own.found.__globals__["shapes"] == [(64, N_OBS)]
    assert torch.equal(agent.decision.action, torch.ones(8, 4)), "cut off at full speed"
    theirs = stepped(sim, "mine.py:Theirs", kind="policy")
    assert torch.equal(theirs.decision.action, torch.full((8, 4), 0.25))


# ---------------------------------------------------------------------------------------------------- answers


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ("None", "gave None; wanted is (8, 4): surge, sway, heave [m/s], yaw rate [rad/s]; does it return"),
        ("np.zeros((8, 3))", "gave 3 columns; wanted is shape (8, 4)"),
        ("np.zeros(4)", "gave shape (4,); wanted is shape (8, 4)"),
        ("np.full((8, 4), np.nan)", "gave nan in row 0, column 0 of 8 x 4"),
        ("np.eye(8, 4) / 0", "in row 0, column 0"),
        ("'forward'", "gave str of <U7; wanted are real numbers"),
        ("np.ones((8, 4), bool)", "gave ndarray of bool"),
        ("[[1, 2], [3]]", "no array"),
        ("torch.ones(8, 4, dtype=torch.complex64)", "gave a tensor of torch.complex64"),
    ],
)
def test_a_wrong_answer_is_told_by_shape_and_kind(sim, write, answer, says):
    write(f"import numpy as np, torch\nnp.seterr(all='ignore')\n\ndef act(view):\n    return {answer}\n")
    with pytest.raises(PluginError) as refused:
        stepped(sim, "mine.py:act")
    assert str(refused.value).startswith("mine.py:4: act: ") and says in str(refused.value)


def test_an_exception_names_the_line_where_her_code_was(sim, write):
    write(
        "import numpy as np\n\ndef helper(view):\n    return view['gaol']\n\n"
        "def act(view):\n    return helper(view)\n"
    )
    with pytest.raises(PluginError) as refused:
        stepped(sim, "mine.py:act")
    told = str(refused.value)
    assert told.startswith("mine.py:4: KeyError: ")
    assert "no column 'gaol'; there are goal, heading_error" in told
    assert told.endswith("(--agent mine.py:act)") and isinstance(refused.value.__cause__, KeyError)
    write("def act(view): ...\ndef reset(rows):\n    raise ValueError('no')\n", "other.py")
    with pytest.raises(PluginError, match=r"other.py:3: ValueError: no \(in reset of --agent other.py:act\)"):
        stepped(sim, "other.py:act")


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ("5", "gave shape (); wanted are waypoints (n, 2) [m]"),
        ("np.zeros((3, 3))", "gave shape (3, 3)"),
        ("[[1, 1], [np.nan, 1]]", "waypoint 1 is [nan, 1.0]; wanted are finite numbers"),
        ("[[1, 1], [-1, 1]]", "waypoint 1 is [-1.0, 1.0], outside the grid of"),
        ("np.ones((10_001, 2))", "at most 10,000"),
    ],
)
def test_a_wrong_route_is_told(sim, write, answer, says):
    write(f"import numpy as np\ndef plan(clearance, cell_m, start, goal, forecast):\n    return {answer}\n")
    sim.planner = found("mine.py", "planner").planner(sim)
    with pytest.raises(PluginError) as refused:
        begin(sim)
    assert str(refused.value).startswith("mine.py:2: plan: ") and says in str(refused.value)


def test_ends_that_are_missing_are_added():
    ends = np.array([1.0, 1.0]), np.array([4.0, 1.0])

    def route(found):
        return adapters.waypoints(found, ends, (20.0, 6.0), "here").tolist()

    assert route(np.zeros((0, 2))) == route([[4, 1]]) == route([[1, 1]]) == [[1, 1], [4, 1]]
    assert route([[2, 2]]) == route([[1, 1], [2, 2], [4, 1]]) == [[1, 1], [2, 2], [4, 1]]


# ---------------------------------------------------------------------------------------------------- planner


def begin(sim):
    mask = torch.ones(sim.num_envs, dtype=torch.int32)
    sim.reset(mask, torch.full_like(mask, 77), torch.arange(sim.num_envs, dtype=torch.int32))


def test_a_planner_plans_every_route_from_what_the_map_says(sim, write):
    write(
        "import numpy as np\nasked, begun = [], []\n"
        "class Plan:\n"
        "    def plan(self, clearance, cell_m, start, goal, forecast, row):\n"
        "        asked.append((row, clearance, cell_m, start, goal, forecast))\n"
        "        return None if row == 3 else [start, (start + goal) / 2 + [0, 0.1], goal]\n"
        "    def reset(self, rows):\n"
        "        begun.extend(rows.tolist())\n"
    )
    own = found("mine.py:Plan", "planner")
    sim.planner = own.planner(sim)
    begin(sim)
    module = vars(__import__("sys").modules[own.found.__module__])
    assert module["begun"] == list(range(8)) and [row for row, *_ in module["asked"]] == list(range(8))
    _row, clearance, cell_m, start, goal, forecast = module["asked"][0]
    own_xy = sim.rows(sim.s.ego.pos_w)[0, :2]
    np.testing.assert_allclose(start + sim.fallback.origin, own_xy, atol=1e-6)
    np.testing.assert_allclose(goal + sim.fallback.origin, sim.rows(sim.s.mission.goal_w)[0, :2], atol=1e-6)
    assert clearance[tuple((start[::-1] // cell_m).astype(int))] > 0 and clearance[0, 0] == 0
    assert forecast.position.shape[1:] == (26, 2) and forecast.radius.shape[0] == len(forecast.position)
    planned, kept = sim.rows(sim.s.route.planned_by), sim.rows(sim.s.route.kept)
    assert planned[:, 2].tolist() == [1, 1, 1, 0, 1, 1, 1, 1] and not planned[:, :2].any()
    assert kept[3] == 1 and sim.rows(sim.s.route.n_way)[3] == 0
    way = sim.rows(sim.s.route.way_w)[0][: sim.rows(sim.s.route.n_way)[0]]
    middle = (start + goal) / 2 + [0, 0.1] + sim.fallback.origin
    assert np.linalg.norm(way - middle, axis=1).min() < 0.01
    assert own.agent(sim) is None and own.document()["calls"] == 8


# --------------------------------------------------------------------------------------------------- the view


def test_a_view_reads_nothing_but_what_the_vehicle_knows():
    named = {path for group in adapters.FIELDS.values() for path in group}
    assert {path.partition(".")[0] for path in named} <= KNOWN


def values_of(view):
    found = [view.obs, view.time_s, view.goal, *view.ego, *view.scan, *view.tracks, *view.map, *view.route]
    return [np.array(value) for value in found]


def test_a_view_is_the_same_where_the_truth_is_spoilt(sim):
    begin(sim)
    sim.observe()
    about = loading.about_of(sim)
    fixed = adapters.Fixed(sim, about.columns, about.limits, "numpy")

    def seen():
        return values_of(
            adapters.PluginView(adapters.Readings(sim, [0, 2, 5], sim.observation[[0, 2, 5]]), fixed)
        )

    poison, before = Poison(sim), seen()
    poison.on()
    spoilt = seen()
    poison.off()
    for one, other in zip(before, spoilt, strict=True):
        np.testing.assert_array_equal(one, other)
    assert len(before) == 30 and all(len(value) == 3 for value in before)


def test_vectors_are_turned_into_the_body(sim, write):
    write(
        "import numpy as np\n"
        "def act(v):\n"
        "    yaw = v.ego.rpy[:, 2]\n"
        "    ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw + 2], -1)\n"
        "    np.testing.assert_allclose(v.in_body(ahead), np.tile([1.0, 0, 2], (8, 1)), atol=1e-6)\n"
        "    np.testing.assert_allclose(v.in_body(ahead[:, :2]), np.tile([1.0, 0], (8, 1)), atol=1e-6)\n"
        "    assert 'sector_range' in repr(v) and v['sector_range'].shape == (8, 12)\n"
        "    v.obs[:] = np.nan\n"
        "    return np.zeros((8, 4))\n"
    )
    stepped(sim, "mine.py:act")
    assert bool(sim.observation.isfinite().all()), "what she writes into is hers"


def test_marks_refuse_other_values():
    with pytest.raises(ValueError, match="rows is 'batch' or 'one'"):
        plugin(rows="some")
    with pytest.raises(ValueError, match="hold_steps is a number"):
        plugin(hold_steps=True)


# ------------------------------------------------------------------------------------------------------- time


def test_time_is_per_decision_and_slow_calls_are_told():
    now, notes = [0.0], []
    meter = CallMeter("--planner mine.py:plan", Path("mine.py"), 0.02, notes.append, lambda: now[0])
    for took in (9.0, 0.01, 0.05, 0.2):
        with meter.call(2):
            now[0] += took
    told = meter.document()
    assert (told["calls"], told["decisions"], told["late_calls"], told["budget_ms"]) == (4, 6, 2, 20.0)
    assert told["decision_ms"] == pytest.approx(1e3 * 0.26 / 6, abs=1e-3) and told["slowest_ms"] == 100.0
    assert meter.told().startswith(
        "--planner mine.py:plan: 2 of 3 calls took longer than a control step (20 ms)"
    )
    assert notes == []
    meter.close()


def test_a_call_that_does_not_come_back_is_told_by_its_line(sim, write):
    write("def act(view):\n    wait()\n    return [[0, 0, 0, 0]] * len(view.rows)\n")
    own, told = found("mine.py:act"), threading.Event()
    own.found.__globals__["wait"] = lambda: told.wait(30)
    notes = []

    def note(text):
        notes.append(text)
        told.set()

    own.note = note
    agent = own.agent(sim)
    agent.code.meter._stall_s = 0.01
    Stepper(sim, agent).reset(*(torch.ones(8, dtype=torch.int32) for _ in range(3)))
    own.close()
    assert notes[0].startswith("mine.py:2: a call of --agent mine.py:act has not come back for")


def test_the_table_has_a_column_for_the_time_of_own_code():
    row = {"name": "x", "episodes": 1, "replans_per_episode": 1.0, "env_steps_per_s": 1.0}
    assert "own code ms\n(slowest)" not in [c.short for c in agents_table([row], "").columns]
    own = row | {"own": {"decision_ms": 0.4, "slowest_ms": 12.0}}
    columns, cells = agents_table([own, row], "").on(TERMINAL)
    assert columns[-1].short == "own code ms\n(slowest)"
    assert [str(line[-1]) for line in cells] == ["0.4 (slowest 12)", "-"]


# ------------------------------------------------------------------------------------------------- commands


@pytest.fixture
def ask(small, monkeypatch, write):
    """Requests on the session's simulator."""
    monkeypatch.setattr(
        "uuvtai.sim.sim.Sim", lambda _config, _num_envs, tree, _device: small.sim.use_tree(tree) or small.sim
    )

    begin_whole = small.sim.reset

    def begin_late(mask, seed, number):
        """Episodes are short: they begin shortly before their horizon."""
        begin_whole(mask, seed, number)
        for row in mask.nonzero().flatten().tolist():
            small.sim.s.clock.step[row] = small.config.episode.horizon_steps - 60

    monkeypatch.setattr(small.sim, "reset", begin_late)

    def request(folder, *agents, **others):
        given = {"agents": [*agents], "episodes": 2, "seeds": [77], "num_envs": 2, "device": "cpu"}
        return Request(config=small.config, world="pool", sensors="paper", run_dir=folder, **given | others)

    yield request
    small.sim.planner = None
    small.sim.use_tree(small.trees["bt"])


def test_pieces_are_rows_beside_the_tree_with_logs_and_pictures(ask, write, tmp_path):
    write(AWAY + AHEAD)
    plugins = ["controller:mine.py:act", "planner:mine.py:plan"]
    result, folder = compare(ask(tmp_path / "run", "straight", *plugins, record=1), Watch())
    assert [m["name"] for m in result["agents"]] == ["straight", "mine-act", "mine-plan"]
    away, planned = result["agents"][1:]
    assert away["own"]["kind"] == "controller" and away["own"]["calls"] > 10 and away["success_rate"] == 0
    assert planned["planned_by"]["voronoi"] == 0 and planned["planned_by"]["own"] >= 2
    assert len(result["paired"]) == 3
    assert {path.name for path in (folder / "logs").iterdir()} >= {"mine-act_seed77_episode0.mcap"}
    assert (folder / "pictures/seed77_episode0.png").stat().st_size > 1000
    kept = json.loads((folder / "eval/request.json").read_text())
    assert kept["agents"] == ["straight", *plugins] and len(kept["digests"]["mine-act"]) == 64


def test_going_on_runs_code_of_a_folder_only_where_the_user_says_so(ask, write, tmp_path):
    """A folder may come from a stranger, and its request names files."""
    write(AWAY.replace("import numpy as np", "import numpy as np\nopen('executed', 'a').write('x')"))
    with pytest.raises(KeyboardInterrupt):
        compare(ask(tmp_path / "run", "controller:mine.py:act"), Watch("mine-act", 1))
    Path("executed").unlink()
    write(Path("mine.py").read_text() + "# changed\n")
    with pytest.raises(
        SettingError, match=r"running the Python code of mine.py; look at it, and add --allow-code"
    ):
        resume(tmp_path / "run", Watch())
    assert not Path("executed").exists()
    with pytest.raises(RunFolderError, match="mine-act has changed since this evaluation began"):
        resume(tmp_path / "run", Watch(), allow_code=True)
    write(Path("mine.py").read_text().removesuffix("# changed\n"))
    result, _folder = resume(tmp_path / "run", Watch(), allow_code=True)
    assert result["agents"][0]["episodes"] == 2


def test_failures_that_are_played_otherwise_are_told_and_left_out():
    recorder = FailureRecorder(Config(), None, [], own_code=True)
    job, result = Job(1, 2), SimpleNamespace(seed=1, episode=2, outcome="timeout", time_s=1.2)
    recorder._expected, recorder._rows = {job: SimpleNamespace(outcome="timeout", time_s=60.0)}, {0: None}
    recorder.end(None, 0, result)
    assert recorder.differed == [job] and recorder.found == {}
    strict = FailureRecorder(Config(), None, [])
    strict._expected, strict._rows = recorder._expected, {0: None}
    with pytest.raises(RuntimeError, match="episodes must be the same in any batch"):
        strict.end(None, 0, result)


def test_the_command_line_tells_in_one_line_and_keeps_the_traceback(write, capfd, tmp_path):
    write("def act(view):\n    return nothing\n\nprint(1 / 0)\n")
    code, out, err = uuv(capfd, "eval", "--agent", "mine.py:act", "--episodes", "1", "--run-dir", "run")
    assert code == 2 and out == "" and not Path("run").exists()
    line = err.strip().splitlines()[-1]
    assert line.startswith("uuv: mine.py:4: ZeroDivisionError: division by zero (while --agent mine.py:act")
    kept = Path(line.rpartition("its traceback: ")[2])
    assert "print(1 / 0)" in kept.read_text()
    kept.unlink()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["eval", "--planner", "none.py"], "none.py cannot be read"),
        (["eval", "--planner", "bt"], "--planner 'bt': names no plugin; for example --planner mine.py:plan"),
        (["sweep", "--agent", "none.onnx", "--grid", "D=0"], "none.onnx cannot be read"),
        (["reproduce", "--agent", "bt"], "bt: is no plugin of yours"),
        (["reproduce", "--planner", "none.py"], "none.py cannot be read"),
        (["simulate", "--seconds", "1", "--agent", "none.py"], "none.py cannot be read"),
        (["simulate", "--seconds", "1", "--agent", "bt", "--wrench", "1,0,0,0,0,0"], "--wrench: not beside"),
    ],
)
def test_wrong_words_are_refused_before_anything_begins(arguments, says, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = uuv(capfd, *arguments)
    assert code == 2 and says in err and out == "" and not list(tmp_path.iterdir())


def test_a_reproduction_compares_pieces_wherever_methods_are_compared(tmp_path):
    own = ["planner:/a/mine.py:plan"]
    steps = {step.folder: step.command for step in steps_of(BUDGETS["paper"], tmp_path, own)}
    having = {folder for folder, command in steps.items() if own[0] in command}
    assert having == {"eval/main", "eval/transfer", "eval/scenario_a", "eval/scenario_b", "sweep/pool"}
    sweep = next(step for step in steps_of(BUDGETS["quick"], tmp_path) if step.folder == "sweep/pool")
    assert "--allow-code" in sweep.argv(tmp_path, resume=True) and "--allow-code" not in sweep.argv(tmp_path)


# ------------------------------------------------------------------------------------------------------- ONNX


GEMM = (("Gemm", ["obs", "w"], ["action"]),)


def graph_of(
    n_obs=N_OBS, nodes=GEMM, n_out=4, hold=None, inputs=("obs",), outputs=("action",), rows=None,
    dtype=np.float32, opset=20,
):  # fmt: skip
    """A policy that multiplies the observation by a small matrix."""
    onnx = pytest.importorskip("onnx", reason="needs the extra uuvtai[export]")
    weights = onnx.numpy_helper.from_array(np.full((n_obs, n_out), 1e-3, dtype), "w")
    made = [onnx.helper.make_node(*node) for node in nodes]
    kind = weights.data_type
    given = [onnx.helper.make_tensor_value_info(name, kind, [rows, n_obs]) for name in inputs]
    out = [onnx.helper.make_tensor_value_info(name, kind, None) for name in outputs]
    graph = onnx.helper.make_graph(made, "g", given, out, [weights])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", opset)], ir_version=10)
    if hold is not None:
        model.metadata_props.add(key="hold_steps", value=hold)
    return model.SerializeToString()


def expected_of(sim):
    return (1e-3 * sim.observation.sum(1, keepdim=True)).clamp(-1, 1).expand(-1, 4)


@pytest.mark.parametrize("changes", [
    {"hold": "5"}, {"rows": 1}, {"rows": 3}, {"dtype": np.float64}, {"opset": 11},
    {"rows": 1, "dtype": np.float64},
], ids=str)  # fmt: skip
def test_a_graph_of_any_trainer_drives(sim, tmp_path, monkeypatch, changes):
    monkeypatch.chdir(tmp_path)
    Path("model.onnx").write_bytes(graph_of(**changes))
    agent = stepped(sim, "model.onnx", steps=0, kind="policy")
    torch.testing.assert_close(agent.decision.action, expected_of(sim), rtol=1e-4, atol=1e-5)
    assert agent.code.marks.hold_steps == int(changes.get("hold", 1))


def test_other_outputs_are_left_out(sim, tmp_path, monkeypatch):
    """A critic beside the actor, by an operator that no policy needs."""
    monkeypatch.chdir(tmp_path)
    nodes = [*GEMM, ("Atan", ["obs"], ["value"])]
    Path("model.onnx").write_bytes(graph_of(nodes=nodes, outputs=("value", "action")))
    agent = stepped(sim, "model.onnx", steps=0, kind="policy")
    torch.testing.assert_close(agent.decision.action, expected_of(sim), rtol=1e-4, atol=1e-5)


def split(graph, location="model.onnx.data", length=None):
    """Its weights as a file's content beside it."""
    import onnx

    model = onnx.load_from_string(graph)
    (tensor,) = model.graph.initializer
    content = tensor.raw_data
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    told = {"location": location, "offset": "16", "length": str(length or len(content))}
    for key, value in told.items():
        tensor.external_data.add(key=key, value=value)
    return model.SerializeToString(), bytes(16) + content


def test_weights_beside_a_graph_are_read(sim, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    graph, weights = split(graph_of())
    Path("model.onnx").write_bytes(graph)
    with pytest.raises(PluginError, match=r"its weights are in model\.onnx\.data, .*copy that file too"):
        found("model.onnx", "policy")
    Path("model.onnx.data").write_bytes(weights)
    agent = stepped(sim, "model.onnx", steps=0, kind="policy")
    torch.testing.assert_close(agent.decision.action, expected_of(sim), rtol=1e-4, atol=1e-5)
    before = found("model.onnx", "policy").sha256
    Path("model.onnx.data").write_bytes(weights[:-1] + b"!")
    assert found("model.onnx", "policy").sha256 != before, "other weights drive otherwise"


@pytest.mark.parametrize(
    ("location", "length", "says"),
    [
        ("../secret", None, "in no other folder"),
        ("/etc/passwd", None, "in no other folder"),
        ("sub/w", None, "in no other folder"),
        ("..", None, "in no other folder"),
        ("", None, "in no other"),
        ("link", None, "is a link"),
        ("short", None, "not whole in short"),
        ("w", 4, "not whole in w"),
    ],
)
def test_weights_of_elsewhere_are_not_read(tmp_path, monkeypatch, location, length, says):
    monkeypatch.chdir(tmp_path)
    graph, weights = split(graph_of(), location, length)
    Path("model.onnx").write_bytes(graph)
    Path("w").write_bytes(weights)
    Path("short").write_bytes(weights[:-1])
    Path("link").symlink_to("w")
    with pytest.raises(UserError, match=says):
        found("model.onnx", "policy")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"rows": 10**6}, "takes no observations"),
        ({"n_obs": 40}, f"takes observations of 40 columns, here they have {N_OBS}"),
        ({"nodes": [("Loop", ["obs"], ["action"])]}, "it has onnx.Loop"),
        ({"nodes": [("Atan", ["obs"], ["action"])]}, "it has onnx.Atan"),
        ({"inputs": ("obs", "last_obs")}, "takes obs, last_obs; a policy takes one input"),
        ({"hold": "0"}, "metadata hold_steps = '0'"),
        ({"hold": "9" * 5000}, "metadata hold_steps = '999"),
    ],
)
def test_a_strange_graph_never_reaches_onnx_runtime(sim, tmp_path, monkeypatch, changes, says):
    monkeypatch.chdir(tmp_path)
    Path("model.onnx").write_bytes(graph_of(**changes))
    if "hold" not in changes:
        monkeypatch.setattr(
            "uuvtai.learning.export.graph.session", lambda _graph: pytest.fail("ONNX Runtime saw it")
        )
    with pytest.raises(PluginError) as refused:
        found("model.onnx", "policy").agent(sim)
    assert str(refused.value).startswith("model.onnx: ") and says in str(refused.value)


def test_what_is_no_graph_or_too_large_is_refused(sim, tmp_path, monkeypatch):
    pytest.importorskip("onnx", reason="needs the extra uuvtai[export]")
    monkeypatch.chdir(tmp_path)
    Path("model.onnx").write_bytes(b"nonsense")
    with pytest.raises(PluginError, match=r"model.onnx: is no ONNX graph"):
        found("model.onnx", "policy").agent(sim)
    with Path("model.onnx").open("wb") as file:
        file.truncate((64 << 20) + 1)
    with pytest.raises(UserError, match="more than the 67,108,864"):
        found("model.onnx", "policy")


def test_a_graph_with_too_few_outputs_is_told(sim, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("model.onnx").write_bytes(graph_of(n_out=3))
    with pytest.raises(PluginError, match=r"model.onnx: gave 3 columns; wanted is shape"):
        stepped(sim, "model.onnx", kind="policy")


# ------------------------------------------------------------------------------------- rewards and motions


REWARD = """import numpy as np

def terms(view):
    drive, end = 0.5 * np.abs(view.action).sum(axis=1), 1.0 * (view.outcome > 0)
    return {"near": -view.clearance, "drive": drive, "end": end}
"""


def rewarded(sim, write, text=REWARD, name="terms"):
    """An environment with terms of the user's."""
    env = VectorEnv(sim, seed=5)
    found(f"{write(text)}:{name}", "reward").reward(env)
    return env


def test_terms_of_a_users_own_are_added_and_summed_by_episode(sim, write):
    plain, n = VectorEnv(sim, seed=5), sim.num_envs
    _obs, info = plain.reset()
    action = torch.full((n, 4), 0.25)
    first = [plain.step(action)[1].clone() for _ in range(3)]
    env = rewarded(sim, write)
    assert env.reward_terms == (*VectorEnv.reward_terms, "near", "drive", "end")
    _obs, info = env.reset()
    assert info["episode"].tolist() == list(range(n)), "asking for the names costs no episode"
    sums = torch.zeros(n, 3)
    for before in first:
        _obs, reward, *_ends, info = env.step(action)
        own = info["reward_terms"][:, -3:]
        near = torch.from_numpy(sim.rows(sim.s.termination.clearance_m))
        torch.testing.assert_close(own, torch.stack([-near, torch.full((n,), 0.5), torch.zeros(n)], 1))
        torch.testing.assert_close(reward, before + own.sum(1))
        sums += own
    torch.testing.assert_close(info["episode_terms"][:, -3:], sums)
    torch.testing.assert_close(info["episode_return"], info["episode_terms"].sum(1), rtol=1e-5, atol=1e-4)
    kept = env.capture()
    after = [part.clone() for part in env.step(action)[:2]]
    env.restore(kept)
    assert all(map(torch.equal, after, env.step(action)[:2]))


@pytest.mark.parametrize("autoreset", [True, False])
def test_the_sums_begin_anew_with_an_episode_and_who_rests_earns_nothing(sim, write, autoreset):
    env = VectorEnv(sim, seed=5, autoreset=autoreset)
    found(f"{write(REWARD)}:terms", "reward").reward(env)
    env.reset()
    late = sim.config.episode.horizon_steps - 2
    for row in range(sim.num_envs):
        sim.s.clock.step[row] = late if row % 2 else 0
    still = torch.zeros(sim.num_envs, 4)
    rows = [env.step(still) for _ in range(2)]
    info, ended = rows[-1][-1], rows[-1][3].clone()
    assert ended.tolist() == [bool(row % 2) for row in range(sim.num_envs)]
    assert info["reward_terms"][:, -1].tolist() == ended.float().tolist(), "the end itself counts"
    whole = info["episode_terms"].clone()
    _obs, reward, *_ends, info = env.step(still)
    if autoreset:
        torch.testing.assert_close(info["episode_terms"][ended, -3:], info["reward_terms"][ended, -3:])
    else:
        assert reward[ended].tolist() == [0.0] * int(ended.sum())
        torch.testing.assert_close(info["episode_terms"][ended, -3:], whole[ended, -3:])


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ("None", "gave NoneType None; wanted is a dict of arrays (8,), what each term adds"),
        ("view.clearance", "gave ndarray"),
        ("{}", "gave dict {}"),
        ("{'two words': view.clearance}", "gave dict {'two words'"),
        ("{'near': view.goal}", "near has shape (8, 3); wanted is a dict of arrays (8,)"),
        ("{'near': 1.0}", "near has shape ()"),
        ("{'near': view.clearance / 0.0 * 0.0}", "near is nan in env 0, and 7 more"),
        ("{'near': ['a'] * 8}", "near: gave list of <U1; wanted are real numbers"),
        ("{'effort': view.clearance}", "effort is a built-in term; name yours otherwise, or weight that one"),
        ("view.obstacles", "a view has no 'obstacles'; there are action, cell_m, clearance, columns"),
        ("view.yaw_rate", "a view has no 'yaw_rate'; a column is view['yaw_rate']; there are"),
    ],
)
def test_a_wrong_reward_is_told_by_its_line(sim, write, answer, says):
    assert sim.num_envs == 8
    with pytest.raises(PluginError) as error:
        rewarded(sim, write, f"def terms(view):\n    return {answer}\n")
    assert "mine.py:" in str(error.value) and says in str(error.value)


def test_terms_that_change_their_names_are_told(sim, write):
    text = "def terms(view):\n    return {'a' if view.time_s[0] < 0.01 else 'b': view.clearance}\n"
    env = rewarded(sim, write, text)
    env.reset()
    with pytest.raises(PluginError, match=r"mine.py:1: terms: gave b, and a at first"):
        env.step(torch.zeros(sim.num_envs, 4))


@pytest.mark.parametrize(
    ("preset", "more", "says"),
    [
        ("policy", [], "needs a preset that trains in the simulator, such as ppo or paper: uuv train ppo"),
        ("best", [], "--reward mine.py:terms: needs a preset that trains in the simulator"),
        ("paper", ["--reward", "none.py:terms"], "none.py cannot be read (No such file"),
        ("paper", ["--reward", "mine.py:term"], "has no 'term'; it has terms"),
        (
            "paper",
            ["--reward", "mine"],
            "--reward 'mine': names no plugin; for example --reward mine.py:terms",
        ),
    ],
)
def test_a_reward_where_there_is_no_use_for_it_is_refused(write, capfd, tmp_path, preset, more, says):
    write(REWARD)
    run = ["--run-dir", str(tmp_path / "run")]
    code, _, err = uuv(capfd, "train", preset, *(more or ["--reward", "mine.py:terms"]), *run)
    assert code == 2 and says in err and not (tmp_path / "run").exists()


def test_a_motion_is_of_the_simulator(write, capfd):
    code, _, err = uuv(capfd, "train", "--motion", f"{write(MOTION)}:paths")
    assert code == 2 and "--motion: needs a preset that trains in the simulator" in err
    Path("long.yaml").write_text(f"extends: pool\nworld: {{fixed: {obstacles_as_yaml()}}}\n")
    config = load_training("policy", [("surrogate.worlds", ["long.yaml"])])
    with pytest.raises(ConfigError, match=r"surrogate.worlds: long.yaml has a path of more than 5 corners"):
        draw_bank(config, ((0, 1, 0.5),), 0, 1)


def obstacles_as_yaml():
    return json.dumps(loading.obstacles_of(plugin_spec("mine.py", "motion")))


def test_a_run_goes_on_with_the_reward_that_it_began_with(write, tmp_path):
    own = found(f"{write(REWARD)}:terms", "reward")
    runner._check_reward(tmp_path, None)
    with pytest.raises(ConfigError, match="began with no --reward; leave it out, or begin a new run"):
        runner._check_reward(tmp_path, own)
    kept = runner._kept(own)
    (tmp_path / runner.REWARD).write_text(json.dumps(kept))
    runner._check_reward(tmp_path, own)
    for other in (None, found(f"{write(REWARD + '# changed')}:terms", "reward")):
        with pytest.raises(ConfigError, match=f"began with --reward {own.spec.typed}; give it unchanged"):
            runner._check_reward(tmp_path, other)
    for strange in ([], kept | {"argument": "other"}, kept | {"name": "other"}):
        (tmp_path / runner.REWARD).write_text(json.dumps(strange))
        with pytest.raises(ConfigError, match="began with --reward"):
            runner._check_reward(tmp_path, own)


def test_what_goes_on_with_a_run_names_all_that_is_asked_for():
    """The line after Ctrl-C is one that works: code of the user's is allowed anew each time."""
    assert to_resume(Path("runs/a b"), ["bt", "policy:net.onnx"]) == "--resume 'runs/a b'"
    assert to_resume(Path("runs/a"), ["bt", "controller:mine.py:act"]) == "--resume runs/a --allow-code"


MOTION = """import numpy as np

def paths():
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    ring = np.column_stack([10 + np.cos(angle), 3 + np.sin(angle)])
    return [{"kind": "sphere", "radius_m": np.float64(0.25), "path": ring, "speed_m_s": 0.8}]
"""


def test_a_motion_of_a_users_own_is_part_of_the_config(write):
    """Nothing but numbers: a run folder and the workers of a sweep need no file of hers."""
    scene = SceneGroup("maze", motion=f"{write(MOTION)}:paths", n_dynamic=2)
    config = scene.config()
    assert [bool(one.path) for one in config.world.fixed] == [False] * 3 + [True]
    moving = config.world.fixed[3]
    assert len(moving.path) == 20 and (moving.x_m, moving.y_m) == (11.0, 3.0) and moving.speed_m_s == 0.8
    assert config.world.obstacles["fixed_moving"] == 1 and config.world.n_dynamic == 2
    assert array_sizes(config, 8)["n_corner"] == 20
    request = SweepRequest.typed(scene, ["bt"], grid=grid_of(["D=0,6"]), episodes=1, seeds=(0,))
    assert base_config(request_of(request.document()), {"D": 0}).world.fixed == config.world.fixed


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ("None", "mine.py: TypeError: 'NoneType' object is not iterable"),
        ("[3]", "TypeError: 'int' object is not iterable"),
        (
            "[{'kind': 'sphere', 'path': [(1, 1), (2, 2)]}]",
            "mine.py:2: obstacle 0: Value error, a sphere needs",
        ),
        ("[{'kind': 'cube', 'x_m': 1, 'y_m': 1}]", "obstacle 0: kind: Input should be 'sphere'"),
        (
            "[{'kind': 'sphere', 'radius_m': 1, 'path': [(1, 1), (float('nan'), 2)]}]",
            "obstacle 0: path.1.x_m",
        ),
        (
            "[{'kind': 'sphere', 'radius_m': 1, 'path': [(1, 1, 1), (2, 2, 2)]}]",
            "obstacle 0: too many values",
        ),
        (
            "[{'kind': 'sphere', 'radius_m': 1, 'path': [(i, 1) for i in range(65)]}]",
            "must have 2 to 64 waypoints",
        ),
        (
            "[{'kind': 'sphere', 'x_m': 1, 'y_m': 1, 'radius': 1}]",
            "obstacle 0: radius: Extra inputs are not permitted; did you mean 'radius_m'?",
        ),
        ("1 / 0", "mine.py:3: ZeroDivisionError: division by zero (--motion mine.py:paths)"),
    ],
)
def test_a_wrong_motion_is_told_by_its_line(write, answer, says):
    write(f"\ndef paths():\n    return {answer}\n")
    with pytest.raises(PluginError) as error:
        loading.obstacles_of(plugin_spec("mine.py", "motion"))
    assert says in str(error.value) and str(error.value).startswith("mine.py:")


def test_a_motion_out_of_the_tank_or_with_arguments_is_told(write):
    with pytest.raises(
        ConfigError, match=r"--set world.added: world.added.0: \(20.5, 3\) is outside the tank"
    ):
        SceneGroup("pool", motion=f"{write(MOTION.replace('10 +', '19.5 +'), 'a.py')}:paths").config()
    write("def paths(tank):\n    return []\n")
    with pytest.raises(PluginError, match=r"a motion is called paths\(\)"):
        loading.obstacles_of(plugin_spec("mine.py", "motion"))


def test_the_spec_of_a_command_is_what_a_request_keeps():
    for kind, file, name, option in (
        ("policy", "m.onnx", "", "--agent m.onnx"),
        ("policy", "m.py", "load", "--agent m.py:load"),
        ("policy", "m.py", "net", "--agent policy:m.py:net"),
        ("planner", "m.py", "plan", "--planner m.py:plan"),
    ):
        assert PluginSpec(kind, Path(file), name).option == option
    assert "m/s" in COMMAND
