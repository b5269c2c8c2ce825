"""Exported policies: NumPy, ONNX Runtime and torch agree with the pilot; folders are checked."""

import ast
import json
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save

from tests.command import run_cli
from tests.learning.export import test_set_export
from tests.learning.export.test_set_export import resigned
from tests.repository.test_telemetry import watched
from uuvtai.common.enums import EGO_COLUMNS, OBSTACLE_WIDTH
from uuvtai.config import ObservationConfig
from uuvtai.config.loader import ConfigError, load_training
from uuvtai.kernels.planning.observation import observation_width, placed_columns
from uuvtai.learning import checkpoint, world_model
from uuvtai.learning.export import folder as deploy
from uuvtai.learning.export import run_policy
from uuvtai.learning.export.card import evaluations_of
from uuvtai.learning.export.folder import of_torch
from uuvtai.learning.export.graph import session
from uuvtai.learning.export.modules import golden_of, module_of, specification, weights_of
from uuvtai.learning.networks import NUM_ACTIONS, ActorCritic
from uuvtai.learning.policy_agent import load_agent
from uuvtai.learning.world_model import WorldModel
from uuvtai.plugins.api import plugin_spec
from uuvtai.plugins.loading import graph_of, onnx_policy

N_OBS = 40
TABLE = [("goal", 0, 3, "m", "body"), ("rest", 3, 30, "1", "level"), ("more", 30, 40, "s", "body")]
SMALL = {"policy.hidden": [16, 16], "world_model.hidden": [16], "world_model.latent": 8}


class Column:
    """A row of an observation table."""

    def __init__(self, name, first, stop, unit, frame):
        self.name, self.slice, self.unit, self.frame = name, slice(first, stop), unit, frame


def config_of(**changes):
    return load_training(
        "smoke", list((SMALL | {key.replace("__", "."): value for key, value in changes.items()}).items())
    )


def networks(config, seen=True):
    """Networks that have seen a batch and act decidedly, as a trainer's state."""
    rng = torch.Generator().manual_seed(0)
    policy, model = ActorCritic(N_OBS + 2, config.policy, rng), WorldModel(N_OBS, config.world_model, rng)
    if not seen:
        return {"policy": policy.state_dict(), "world_model": model.state_dict(), "env": {}}
    policy.observation_norm.update(3.0 * torch.randn(500, N_OBS + 2, generator=rng) + 1.0)
    policy.value_norm.update(20.0 * torch.randn(500, 1, generator=rng) + 5.0)
    with torch.no_grad():
        policy.actor[-1].weight.copy_(torch.randn(policy.actor[-1].weight.shape, generator=rng))
    state = {"policy": policy.state_dict(), "env": {}}
    if config.world_model.enabled:
        model.observation_norm.update(3.0 * torch.randn(500, N_OBS, generator=rng))
        state["world_model"] = model.state_dict()
    return state


def saved(folder, config=None, metrics=None, seen=True, **changes):
    """A run folder with one checkpoint."""
    config = config or config_of(**changes)
    table = [Column(*row) for row in TABLE]
    checkpoint.save(folder / "checkpoints", 3, networks(config, seen), config, table, metrics=metrics)
    return checkpoint.newest(folder)


def exported(found, out, note=lambda _text: None, evaluations=()):
    return deploy.export(found, "mine", out, evaluations, note)


# -------------------------------------------------------------------------------------------------- agreement

CASES = {
    "plain, held for ten": {"policy.hold_steps": 10},
    "no features, tanh": {
        "world_model.as_features": False,
        "policy.activation": "tanh",
        "policy.hold_steps": 3,
    },
    "relu": {"policy.activation": "relu"},
}


def driver(found, module):
    arrays = {name: tensor.numpy() for name, tensor in weights_of(module).items()}
    return run_policy.made(specification(found, module, "mine", False), arrays)


def mission(policy, agent):
    """(exported policy, agent) at every step of a mission that begins again in the middle: all they say."""
    rng, rows = torch.Generator().manual_seed(3), []
    for step, obs in enumerate(3.0 * torch.randn(90, N_OBS, generator=rng) + 1.0):
        if step % 47 == 0:
            policy.reset()
            agent.reset(torch.ones(1))
        obs[step % N_OBS] = (1.0, float("nan"), float("inf"))[step % 3]
        rows.append((policy.act(obs.numpy()), agent.decide(obs[None])))
        agent.advance()
    names = "action", "value", "residual", "uncertainty"
    return [
        np.stack([np.concatenate([np.ravel(getattr(one, name)) for name in names]) for one in told])
        for told in zip(*rows, strict=True)
    ]


@pytest.mark.parametrize("changes", CASES.values(), ids=CASES)
def test_numpy_and_a_decision_without_memory_agree_with_the_pilot(tmp_path, changes):
    found = saved(tmp_path, load_training("smoke", list((SMALL | changes).items())))
    module, golden = module_of(found), golden_of(module_of(found))
    policy = driver(found, module)
    assert run_policy.of_numpy(policy, golden)["agrees"] and of_torch(module, golden)["agrees"]
    has_model = module.world_model is not None
    assert (golden["pair_features"] > 0).any() == has_model and (golden["pair_features"][0] == 0).all()
    assert not np.isfinite(golden["pair_obs"]).all(), "sensors that fail are among the golden pairs"
    said, done = mission(policy, load_agent(found, 1))
    assert (
        max(run_policy.difference(*columns) for columns in zip(said.T, done.T, strict=True))
        <= run_policy.TOLERANCE
    )
    assert done[:, :4].std() > 0.1 and np.abs(done[:, :4]).max() <= 1.0
    assert (done[:, 5] > 0).any() == has_model


def test_networks_that_have_seen_nothing_agree_too(tmp_path):
    found = saved(tmp_path, seen=False)
    module = module_of(found)
    assert run_policy.of_numpy(driver(found, module), golden_of(module))["agrees"]


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """(folder of an exported policy that decides at every tenth step, its checkpoint)"""
    return without_graph(tmp_path_factory.mktemp("held"), policy__hold_steps=10)


def test_a_held_action_does_not_follow_the_newest_observation(held):
    policy = run_policy.load(held[0])
    first, second = policy.act(np.zeros(N_OBS)), policy.act(np.ones(N_OBS))
    np.testing.assert_array_equal(second.action, first.action)
    np.testing.assert_allclose(second.command_si, second.action * [0.6, 0.6, 0.4, 1.0], rtol=1e-6)
    assert second.value == first.value, "what it thinks is held too"
    policy.reset()
    assert policy.act(np.ones(N_OBS)).value != first.value


def test_an_observation_of_another_width_is_refused(folder):
    with pytest.raises(ValueError, match=r"must have shape \(40,\), got \(39,\)"):
        run_policy.load(folder).act(np.zeros(39))


# ----------------------------------------------------------------------------------------------------- folder


IN_ONE_PROCESS = """
import pathlib, runpy, torch, types, uuvtai
from uuvtai import cli
from uuvtai.learning.networks import PlainAdam, mlp

net = mlp([3, 4, 1], "elu", torch.Generator())
adam = PlainAdam(net.parameters(), fused=True)
net(torch.ones(2, 3)).sum().backward()
adam.step(), adam.zero_grad(), adam.state_dict()

def done(*words):
    try:
        cli.main(list(words))
    except SystemExit as left:
        assert left.code == 0, left.code

def times(folder):
    return sorted((path.name, path.lstat().st_mtime_ns) for path in pathlib.Path(folder).rglob("*"))

for name in ("plain", "set"):
    done("export", f"{ROOT}/{name}", "--out", f"{ROOT}/{name}_out")
    before = times(f"{ROOT}/{name}_out")
    done("export", "--check", f"{ROOT}/{name}_out")
    assert times(f"{ROOT}/{name}_out") == before, "the check wrote into the folder"
uuvtai.make = lambda *_given, **_others: types.SimpleNamespace(num_obs=N_OBS, columns=COLUMNS)
os.chdir(ROOT)
runpy.run_path(EXAMPLE, run_name="__main__")
print("compiler:", "torch._dynamo" in sys.modules)
"""
EXAMPLE = Path(__file__).parents[3] / "examples/own_onnx.py"


def of_an_environment():
    """(width, columns) of an observation."""
    found = placed_columns(ObservationConfig())
    return observation_width(ObservationConfig()), {c.name: slice(at, at + width) for c, at, width in found}


@pytest.fixture(scope="module")
def graphs(tmp_path_factory):
    """Two exported policies, each checked, and a graph of a user's own, all made by one process that is
    watched. (folder, home of the process, its answer)"""
    for name in ("onnx", "onnxruntime"):
        pytest.importorskip(name, reason="needs the extra uuvtai[export]")
    root = tmp_path_factory.mktemp("graphs")
    saved(root / "plain", policy__hold_steps=10)
    test_set_export.saved(root / "set")
    n_obs, columns = of_an_environment()
    values = {"ROOT": str(root), "N_OBS": n_obs, "COLUMNS": columns, "EXAMPLE": str(EXAMPLE)}
    given = "".join(f"{name} = {value!r}\n" for name, value in values.items())
    home = tmp_path_factory.mktemp("elsewhere")
    return root, home, watched(given + IN_ONE_PROCESS, home)


def test_export_and_check_open_no_socket_and_write_nowhere_else(graphs):
    """The whole command, ONNX graph included; then its check, which holds a session of ONNX Runtime. Neither
    they nor a training's optimiser import torch's compiler, which takes eight seconds."""
    root, home, answer = graphs
    assert answer.count("ONNX Runtime") >= 4
    assert "sockets: []" in answer and "variable: 1" in answer and "loaded: True" in answer, answer
    assert "compiler: False" in answer
    assert [path for path in home.rglob("*") if path.is_file()] == []
    assert {path.name for path in root.iterdir()} == {"plain", "plain_out", "set", "set_out", "model.onnx"}


def test_onnx_runtime_agrees_and_the_folder_passes_its_check(graphs, capfd):
    out = graphs[0] / "plain_out"
    again = deploy.check(out, print)
    assert again["agrees"] and [one["engine"] for one in again["engines"]] == ["NumPy", "ONNX Runtime"]
    assert all(0 < one["p50_ms"] <= one["p99_ms"] for one in again["engines"])
    assert capfd.readouterr().out == "", "results only on stdout"
    spec = run_policy.read_spec(out)
    assert set(spec["graph"]["inputs"]) == {"obs", "last_obs", "last_action", "has_last"}
    assert set(spec["graph"]["outputs"]) == {"mean_action", "value", "features"}


def test_the_graph_of_a_policy_over_a_set_says_the_same(graphs):
    out = graphs[0] / "set_out"
    spec, policy = run_policy.read_spec(out), run_policy.load(out)
    assert set(spec["graph"]["inputs"]) == set(policy.inputs)
    golden = run_policy.read_safetensors(out / "golden.safetensors")
    said = policy.said({name: golden[f"pair_{name}"] for name in policy.inputs})
    assert set(spec["graph"]["outputs"]) == set(said)
    rng = np.random.default_rng(0)
    few = {"obstacles": rng.normal(size=(3, 2, OBSTACLE_WIDTH)), "own": rng.normal(size=(3, EGO_COLUMNS))}
    few = {name: array.astype(np.float32) for name, array in few.items()}
    few["obstacles"][..., 0] = 1.0
    (wish, *_) = session((out / "policy.onnx").read_bytes()).run(["mean_wish"], few)
    np.testing.assert_allclose(wish, policy.said(few)["mean_wish"], atol=1e-5)


def test_the_example_writes_a_graph_that_is_taken_as_a_policy(graphs, monkeypatch):
    """``python examples/own_onnx.py``, then ``uuv eval --agent model.onnx``."""
    monkeypatch.chdir(graphs[0])
    n_obs, columns = of_an_environment()
    spec = plugin_spec("model.onnx", "policy")
    act, hold_steps = onnx_policy(spec, graph_of(spec), n_obs)
    obs = torch.randn(64, n_obs)
    own = runpy.run_path(str(EXAMPLE))["Policy"](columns)
    np.testing.assert_allclose(act(obs.numpy()), own(obs), rtol=1e-5, atol=1e-6)
    assert hold_steps == 10


def test_the_specification_says_what_every_column_is(held):
    out, found = held
    spec = run_policy.read_spec(out)
    columns = spec["observation"]["columns"]
    assert [column["index"] for column in columns] == list(range(N_OBS))
    norm = load_agent(found, 1).policy.observation_norm
    mean, std = float(norm.mean[2]), float(norm.std()[2])
    assert columns[2] == {
        "index": 2, "name": "goal[2]", "unit": "m", "frame": "body", "mean": mean, "std": std,
    }  # fmt: skip
    assert [row["name"] for row in spec["features"]] == ["residual", "uncertainty"]
    assert [(row["name"], row["limit"], row["unit"]) for row in spec["action"]] == [
        ("surge", 0.6, "m/s"), ("sway", 0.6, "m/s"), ("heave", 0.4, "m/s"), ("yaw_rate", 1.0, "rad/s"),
    ]  # fmt: skip
    assert (spec["rate"]["control_hz"], spec["rate"]["decision_hz"], spec["rate"]["hold_steps"]) == (
        50.0,
        5.0,
        10,
    )
    assert spec["checkpoint"]["sha256"] == found.sha256
    listed = {path.name for path in out.iterdir()} - {"policy_spec.json"}
    assert (
        set(spec["files"])
        == listed
        == {"policy.safetensors", "golden.safetensors", "README.md", "run_policy.py"}
    )


def test_the_folder_drives_where_there_is_numpy_alone(folder):
    """Without torch and uuvtai; the file imports NumPy and the standard library alone."""
    code = (
        "import sys, runpy\n"
        "class Guard:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('torch', 'uuvtai', 'taichi', 'safetensors', 'onnxruntime', "
        "'onnx'): raise ImportError(name)\n"
        "sys.meta_path.insert(0, Guard()); sys.argv = ['run_policy.py']; runpy.run_path('run_policy.py', "
        "run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "features: largest difference" in done.stdout and "p50" in done.stdout
    roots = {
        (node.module or "").split(".")[0]
        if isinstance(node, ast.ImportFrom)
        else node.names[0].name.split(".")[0]
        for node in ast.walk(ast.parse((folder / "run_policy.py").read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
    }
    assert roots - set(sys.stdlib_module_names) == {"numpy"}


def test_constants_that_the_driver_repeats_are_those_of_the_package():
    assert (run_policy.N_TARGET, run_policy.N_ACTION) == (world_model.N_TARGET, NUM_ACTIONS)
    assert (run_policy._LOG_VAR, run_policy._LARGEST_ERROR) == (
        world_model.LOG_VAR_BOUNDS,
        world_model.LARGEST_ERROR,
    )


def test_without_the_extra_the_graph_is_left_out_and_told(tmp_path, no_onnx):
    notes = []
    found = exported(saved(tmp_path / "run"), tmp_path / "out", notes.append)
    assert found["agrees"] and not (tmp_path / "out" / "policy.onnx").exists()
    assert "pip install 'uuvtai[export]'" in notes[0]
    assert run_policy.read_spec(tmp_path / "out")["graph"] is None


def test_a_place_that_is_taken_is_refused_and_a_full_disk_leaves_nothing(tmp_path, no_onnx, monkeypatch):
    found = saved(tmp_path / "run")
    (tmp_path / "out").mkdir()
    with pytest.raises(ConfigError, match="already there; give another folder with --out"):
        exported(found, tmp_path / "out")

    def full(path, content):
        if path.name == "golden.safetensors":
            raise OSError(28, "No space left on device")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    monkeypatch.setattr(deploy, "write_atomic", full)
    with pytest.raises(RuntimeError, match="No space left"):
        exported(found, tmp_path / "other")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "run"]


# ------------------------------------------------------------------------------------------------------- card


def result_of(found, k=90, n=100):
    """A result of ``uuv eval`` with this checkpoint and a tree."""
    outcomes = {"success": k, "collision": n - k - 2, "ttc": 1, "out_of_tank": 0, "timeout": 1}
    agents = [{"name": "bt", "episodes": n, "outcomes": outcomes}]
    agents.append(
        {"name": "mine", "episodes": n, "outcomes": outcomes, "checkpoint": {"sha256": found.sha256}}
    )
    return {
        "world": "pool", "S": 8, "D": 6, "v_m_s": 0.6, "sensors": "paper", "seeds": [1, 2], "agents": agents,
    }  # fmt: skip


def written(folder, result):
    (folder / "eval").mkdir(parents=True)
    (folder / "eval" / "result.json").write_text(json.dumps(result))
    return folder


def test_the_card_has_counts_and_intervals(tmp_path, no_onnx):
    found = saved(
        tmp_path / "run",
        metrics={"eval/success_rate": 0.5, "eval/collision_rate": 0.25, "time/env_steps": 2e6},
    )
    written(tmp_path / "run" / "eval_pool", result_of(found))
    elsewhere = written(tmp_path / "elsewhere", result_of(found, 40, 50))
    exported(found, tmp_path / "out", evaluations=[elsewhere])
    card = (tmp_path / "out" / "README.md").read_text()
    assert (
        "pool, S = 8, D = 6, v = 0.6 m/s, paper sensing, seed 1, 2 | 90/100 = 90.0 % [82.6, 94.5] | 9/100 = "
        "9.0 %" in card
    )
    assert "40/50 = 80.0 %" in card and "2/4 = 50.0 % [15.0, 85.0] | 1/4" in card
    assert "too good by selection" in card
    assert "2.00 million env-steps" in card


def test_without_evaluations_the_card_says_so(folder):
    assert "No evaluation was at hand" in (folder / "README.md").read_text()


def test_evaluations_of_something_else_are_refused(tmp_path):
    found = saved(tmp_path / "run")
    other = result_of(found)
    other["agents"][1]["checkpoint"]["sha256"] = "0" * 64
    with pytest.raises(ConfigError, match="does not evaluate this checkpoint"):
        evaluations_of(found, [written(tmp_path / "other", other)])
    for number, broken in enumerate(
        (result_of(found, k=-3), {"agents": [3]}, [], {"agents": [{"checkpoint": {"sha256": found.sha256}}]})
    ):
        with pytest.raises(ConfigError, match="is no result of uuv eval"):
            evaluations_of(found, [written(tmp_path / str(number), broken)])
    with pytest.raises(ConfigError, match="is no result of uuv eval"):
        evaluations_of(found, [tmp_path / "nowhere"])


# ---------------------------------------------------------------------------------------------------- command


def without_graph(root, **changes):
    """(exported folder, its checkpoint); ONNX takes seconds."""
    found = saved(root / "run", **changes)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(deploy, "missing_packages", lambda: ["onnx"])
        exported(found, root / "out")
    return root / "out", found


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An exported policy."""
    return without_graph(tmp_path_factory.mktemp("export"))[0]


@pytest.fixture
def folder(whole, tmp_path):
    """A copy of it to be spoiled."""
    return Path(shutil.copytree(whole, tmp_path / "out"))


def test_the_command_exports_prints_and_checks(tmp_path, no_onnx, capfd):
    saved(tmp_path / "run")
    assert run_cli("export", tmp_path / "run", "--out", tmp_path / "out", "--json") == 0
    answer = capfd.readouterr()
    document = json.loads(answer.out)
    assert document["agrees"] and [engine["engine"] for engine in document["engines"]] == ["torch", "NumPy"]
    assert "left out policy.onnx" in answer.err
    assert run_cli("export", "--check", tmp_path / "out") == 0
    assert "agrees" in capfd.readouterr().out


@pytest.mark.parametrize("name", ["policy.safetensors", "golden.safetensors", "README.md", "run_policy.py"])
def test_a_changed_file_is_exit_3(folder, name, capfd):
    content = bytearray((folder / name).read_bytes())
    content[-1] ^= 1
    (folder / name).write_bytes(content)
    assert run_cli("export", "--check", folder) == 3
    assert f"{name}: has changed" in capfd.readouterr().err


def test_other_weights_with_the_right_sha256_are_exit_3(folder, tmp_path, capfd):
    weights = weights_of(module_of(saved(tmp_path / "other", config_of(), metrics={"a": 1.0})))
    weights["actor.4.bias"] += 0.01
    resigned(folder, "policy.safetensors", save(weights))
    assert run_cli("export", "--check", folder) == 3
    assert "DIFFERS" in capfd.readouterr().out
    done = subprocess.run(
        [sys.executable, "run_policy.py"], cwd=folder, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 3


@pytest.mark.parametrize(
    ("arguments", "says", "code"),
    [
        (["export"], "give the RUN to export", 2),
        (["export", "x", "--check", "y"], "give the RUN to export", 2),
        (["export", "nothing"], "is no trained policy", 2),
        (["export", "--check", "nothing"], "policy_spec.json: is missing", 2),
    ],
)
def test_bad_usage(arguments, says, code, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_cli(*arguments) == code
    assert says in capfd.readouterr().err
