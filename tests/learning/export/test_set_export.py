"""Exported policies over a set: all runtimes agree, the hull rule is the kernel's, folders are checked."""

import copy
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from tests.command import run_cli
from tests.oracles import hull_rule as reference
from uuvtai.common.enums import EGO_COLUMNS, N_OBSTACLE, N_RAY, OBSTACLE_WIDTH, OWN_WIDTH
from uuvtai.config import TankConfig, VehicleConfig
from uuvtai.config.loader import load_training
from uuvtai.learning import checkpoint, set_networks
from uuvtai.learning.agents import load_set_agent
from uuvtai.learning.checkpoint import CheckpointError
from uuvtai.learning.export import folder as deploy
from uuvtai.learning.export import run_policy
from uuvtai.learning.export.modules import OBSTACLE_COLUMNS, OWN_COLUMNS, hull_rule_of, module_of, safety_of
from uuvtai.learning.set_networks import SetActor, SetCritic
from uuvtai.sim.stages import bind
from uuvtai.surrogate.arrays import TRUTH_WIDTH, Rules
from uuvtai.surrogate.observation import SET_TABLE
from uuvtai.surrogate.safety import filter_wishes

NET = {"surrogate.obstacle_hidden": 8, "surrogate.head_hidden": 8}


def filled(module, seed, spread=0.3):
    """With weights that say something."""
    rng = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for tensor in module.parameters():
            tensor.add_(spread * torch.randn(tensor.shape, generator=rng))
    return module


def saved(folder, change=None):
    """A run folder with one checkpoint, after ``change`` of its state."""
    config, rng = load_training("policy", overrides=NET), torch.Generator().manual_seed(1)
    actor = filled(SetActor(config, rng), 2)
    critic = SetCritic(TRUTH_WIDTH, config, rng)
    state = {"policy": actor.state_dict(), "critic": critic.state_dict(), "counters": {}, "env": {}}
    state = copy.deepcopy(state)
    if change:
        change(state)
    metrics = {"eval/success_rate": 0.5, "eval/collision_rate": 0.25}
    checkpoint.save(folder / "checkpoints", 3, state, config, SET_TABLE, metrics=metrics)
    return checkpoint.newest(folder)


def resigned(folder, name, content):
    """Put other content in a file, with its right sha256 in the specification."""
    (folder / name).write_bytes(content)
    spec = json.loads((folder / "policy_spec.json").read_text())
    spec["files"][name] = run_policy.hashlib.sha256(content).hexdigest()
    (folder / "policy_spec.json").write_text(json.dumps(spec))


def exported(folder):
    """(checkpoint, what was exported, into which folder)."""
    found, out = saved(folder / "run"), folder / "out"
    return found, deploy.export(found, "mine", out, (), lambda _text: None), out


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """(checkpoint, exported folder without a graph)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(deploy, "missing_packages", lambda: ["onnx"])
        found, done, out = exported(tmp_path_factory.mktemp("set"))
    assert [each["engine"] for each in done["engines"]] == ["torch", "NumPy"] and done["agrees"]
    return found, out


@pytest.fixture
def folder(whole, tmp_path):
    """A copy of it to be spoiled."""
    return Path(shutil.copytree(whole[1], tmp_path / "out"))


def test_a_folder_has_its_driver_and_checks_itself(whole, capfd):
    _, folder = whole
    spec = run_policy.read_spec(folder)
    listed = {path.name for path in folder.iterdir()} - {"policy_spec.json", "__pycache__"}
    assert (
        set(spec["files"])
        == listed
        == {"policy.safetensors", "golden.safetensors", "README.md", "run_policy.py"}
    )
    assert spec["kind"] == "set" and spec["graph"] is None
    assert run_cli("export", "--check", folder) == 0
    assert "agrees" in capfd.readouterr().out


def test_the_card_says_where_it_was_judged(whole):
    """Not in the config's own world: in all worlds and scenes that it learnt in."""
    card = (whole[1] / "README.md").read_text()
    assert "the kinematic surrogate, pool, gauntlet and maze, S = 8, D = 9, v = 1.5 m/s; " in card
    told = "| 770/1539 = 50.0 % | 385/1539 = 25.0 % |"
    assert told in card, "no interval: scenes share their episodes' numbers"
    assert "own world" not in card


def test_the_golden_pairs_say_something(whole):
    golden = run_policy.read_safetensors(whole[1] / "golden.safetensors")
    there = golden["pair_obstacles"][..., 0]
    assert set(there.sum(1).astype(int)) >= {0, 1, N_OBSTACLE} and np.ptp(golden["pair_mean_wish"]) > 0.5
    assert (golden["pair_obstacles"][there == 0] == 0).all()


def test_no_critic_and_no_truth_is_exported(whole):
    """Every array is one of the networks that drive, and every input what the vehicle knows."""
    found, folder = whole
    arrays = run_policy.read_safetensors(folder / "policy.safetensors")
    assert set(arrays) == {f"actor.{name}" for name in module_of(found).actor.net.state_dict()}
    assert not any("critic" in name or "log_std" in name for name in arrays)
    text = (folder / "policy_spec.json").read_text() + (folder / "README.md").read_text()
    assert "critic" not in text and "truth" not in text
    assert arrays["actor.obstacle.0.weight"].shape[1] == OBSTACLE_WIDTH
    assert arrays["actor.own.0.weight"].shape[1] == EGO_COLUMNS


# ------------------------------------------------------------------------------------------------ what drives


def test_the_folder_commands_what_the_pilot_commands_in_the_simulator(small, tmp_path, no_onnx):
    """Columns that the pilot wrote, the wish, and the hull rule where each vehicle then is."""
    found, _, out = exported(tmp_path)
    policy, pilot = run_policy.load(out), load_set_agent(found, small.sim)
    small.begin(range(small.N), seed=5)
    pilot.reset(torch.ones(small.N))
    ways = small.sim.rows(small.sim.s.mission.goal_w) - small.sim.rows(small.sim.s.mission.start_w)
    for step in range(7):
        action = pilot.decide(torch.zeros(small.N, 1)).action.numpy()
        yaw, z = (small.sim.rows(small.sim.s.ego.rpy)[:, 2], small.sim.rows(small.sim.s.ego.pos_w)[:, 2])
        if step % 5 == 0:
            wishes = [
                policy.act(obstacles, own).wish
                for obstacles, own in zip(pilot.obstacles.numpy(), pilot.own.numpy(), strict=True)
            ]
            np.testing.assert_allclose(wishes, pilot.wish.numpy(), atol=1e-5)
        flips = np.where(ways[:, :2] >= 0, 1, -1)
        commands = [policy.command(*row) for row in zip(wishes, flips, yaw, z, strict=True)]
        np.testing.assert_allclose(commands, action, atol=1e-5)
        assert np.abs(commands).max() > 0.1
        small.sim.step(torch.from_numpy(action))
        pilot.advance()


def test_the_hull_rule_is_that_of_the_oracle():
    config = load_training("policy", overrides=NET)
    decision = module_policy()
    rng = np.random.default_rng(0)
    low, high = [-1.5, -1.5, -1.5, -np.pi, -1.6], [1.5, 1.5, 1.5, np.pi, 0.0]
    rule = hull_rule_of(config)
    for x, y, up, yaw, z in rng.uniform(low, high, (300, 5)):
        flip = rng.choice([-1, 1], 2)
        long = max(1.0, np.hypot(x, y))
        wish = np.array([*(rule["fastest_m_s"] * flip * [x, y] / long), np.clip(up, -1, 1) * 0.4])
        wanted = reference.hull_command(wish, yaw, z, rule["gap_m"], VehicleConfig(), TankConfig())
        np.testing.assert_allclose(decision.command((x, y, up), flip, yaw, z), wanted, atol=1e-5)
    assert rule["limits_m_s"]["heave"] == 0.4 and rule["z_m"] == [-1.6, 0.0]
    assert decision.command((0.01, 0.0, 0.0), (1, 1), 0.3, -0.8)[3] == 0.0, "too slow to turn for"


def module_policy(safety=()):
    """A policy of made-up weights, without a folder."""
    config = load_training("policy", overrides=NET)
    actor = SetActor(config, torch.Generator().manual_seed(1))
    spec = {
        "observation": {
            "meaning": "",
            "obstacles": {"columns": [0] * OBSTACLE_WIDTH},
            "own": {"columns": [0] * EGO_COLUMNS},
        },
        "network": {"goal_gain": 0.7},
        "hull_rule": hull_rule_of(config),
        "safety": safety_of(config) | dict(safety),
    }
    arrays = {f"actor.{name}": tensor.numpy() for name, tensor in actor.net.state_dict().items()}
    return run_policy.SetPolicy(spec, arrays)


def test_the_safety_filter_is_that_of_the_vehicle():
    """Obstacles on every side, level, above and below, near walls and far: the same wish is left."""
    rng, n, config = np.random.default_rng(5), 200, load_training("policy", overrides=NET)
    obstacles, own = np.zeros((n, 4, OBSTACLE_WIDTH), np.float32), np.zeros((n, EGO_COLUMNS), np.float32)
    way, speed = rng.uniform(-5, 5, (n, 4, 2)), rng.uniform(-1.5, 1.5, (n, 4, 2))
    turn = rng.uniform(-0.3, 0.3, (n, 4, 2))
    for first, ahead in ((1, way), (12, way + speed + turn), (14, way + 2 * speed)):
        obstacles[..., first : first + 2] = ahead / 4
    obstacles[..., 0], obstacles[..., 7] = rng.integers(0, 2, (n, 4)), rng.uniform(0.2, 0.8, (n, 4))
    obstacles[..., 8:10] = rng.uniform(0, 0.6, (n, 4, 2)) * rng.integers(0, 2, (n, 4, 1))
    own[:, 6:8], own[:, OWN_WIDTH:] = rng.uniform(-0.8, 0.8, (n, 2)), rng.uniform(-0.26, 0.2, (n, N_RAY))
    own[::4, OWN_WIDTH:] += rng.uniform(0, 2.6, (n // 4, N_RAY))
    wish = rng.uniform(-2, 2, (n, 3)).astype(np.float32)
    found, policy = torch.from_numpy(wish.copy()), module_policy()
    filter_wishes(
        bind(Rules, config), config.surrogate.safety_horizon_s, torch.ones(n, dtype=torch.int32),
        torch.from_numpy(obstacles), torch.from_numpy(own), found,
    )  # fmt: skip
    wanted = [policy.kept_safe(*row) for row in zip(wish, obstacles, own, strict=True)]
    np.testing.assert_allclose(found, wanted, atol=1e-5)
    changed = (found.numpy() != wish).any(1)
    assert 20 < changed.sum() < n - 20


@pytest.mark.parametrize(
    "change",
    [
        {"directions": 1e9},
        {"step_s": 0.0},
        {"step_s": 1e-9},
        {"horizon_s": -1.0},
        {"lag_s": 0.0},
        {"hull_m": "wide"},
    ],
)
def test_a_filter_with_impossible_numbers_is_refused_before_it_drives(change):
    with pytest.raises((ValueError, ArithmeticError)):
        module_policy(change)


def test_order_and_number_of_obstacles_do_not_matter():
    policy, rng = module_policy(), np.random.default_rng(3)
    obstacles, own = rng.normal(size=(5, OBSTACLE_WIDTH)), rng.normal(size=EGO_COLUMNS)
    obstacles[:, 0] = 1.0
    wish = policy.act(obstacles, own).wish
    np.testing.assert_allclose(policy.act(obstacles[::-1], own).wish, wish, atol=1e-6)
    more = np.concatenate([obstacles, np.zeros((4, OBSTACLE_WIDTH))])
    np.testing.assert_allclose(policy.act(more, own).wish, wish, atol=1e-6)


def test_words_and_constants_are_those_of_the_package():
    assert (len(OBSTACLE_COLUMNS), len(OWN_COLUMNS)) == (OBSTACLE_WIDTH, EGO_COLUMNS)
    names = [row["name"] for row in OBSTACLE_COLUMNS + OWN_COLUMNS]
    assert names[12] == "way_in_1s.x" and names[OBSTACLE_WIDTH + 3] == "route_direction.x"
    for own, theirs in (
        (run_policy.AT_DIRECTION, set_networks.AT_DIRECTION),
        (run_policy.SUM_SCALE, set_networks._SUM_SCALE),
        (run_policy.MOST_WISH, set_networks.MOST_WISH),
    ):
        assert own == theirs


# -------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda b, o: (b[:, 1:], o), r"obstacles must have shape \(n, 22\)"),
        (lambda b, o: (b[0], o), r"obstacles must have shape \(n, 22\)"),
        (lambda b, o: (b[:0], o), r"obstacles must have shape \(n, 22\)"),
        (lambda b, o: (b, o[1:]), r"own must have shape \(46,\), got \(45,\)"),
        (lambda b, o: (b * np.nan, o), "not finite"),
        (lambda b, o: (b, o * np.inf), "not finite"),
        (lambda b, o: (b * 0.5, o), "first column"),
    ],
)
def test_bad_columns_are_refused(change, says):
    with pytest.raises(ValueError, match=says):
        module_policy().act(*change(np.ones((3, OBSTACLE_WIDTH)), np.ones(EGO_COLUMNS)))


@pytest.mark.parametrize(
    "change",
    [
        lambda s: s["policy"]["net.own.0.bias"].fill_(float("nan")),
        lambda s: s["policy"].pop("net.own.0.bias"),
    ],
)
def test_networks_that_cannot_drive_are_not_exported(change, tmp_path, no_onnx):
    found = saved(tmp_path / "run", change)
    with pytest.raises(CheckpointError, match=r"is not finite|not those of its config"):
        deploy.export(found, "mine", tmp_path / "out", (), lambda _text: None)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "change",
    [
        lambda a: a.pop("actor.own.0.bias"),
        lambda a: a.update({"actor.obstacle.0.weight": a["actor.obstacle.0.weight"][:, 1:]}),
        lambda a: a.clear(),
    ],
)
def test_arrays_that_do_not_fit_the_specification(change, folder):
    arrays = dict(run_policy.read_safetensors(folder / "policy.safetensors"))
    change(arrays)
    with pytest.raises(run_policy.PolicyError, match="do not fit together"):
        run_policy.made(run_policy.read_spec(folder), arrays)


@pytest.mark.parametrize("other", ["tree", 3, [], None])
def test_a_kind_that_is_none_is_refused(other, folder, capfd):
    spec = json.loads((folder / "policy_spec.json").read_text()) | {"kind": other}
    (folder / "policy_spec.json").write_text(json.dumps(spec))
    assert run_cli("export", "--check", folder) == 2
    assert "not one of mlp, set" in capfd.readouterr().err


@pytest.mark.parametrize(
    "change",
    [
        lambda g: g.pop("pair_own"),
        lambda g: g.pop("pair_mean_wish"),
        lambda g: g.update({"pair_more": g["pair_own"]}),
        lambda g: g.update({"pair_own": g["pair_own"][:5]}),
        lambda g: g.update({"pair_obstacles": g["pair_obstacles"] * np.float32(0.5)}),
        lambda g: g.update({"pair_obstacles": np.zeros((0, 9, OBSTACLE_WIDTH), np.float32)}),
        lambda g: g.update({"pair_obstacles": np.array(3, np.float32)}),
        lambda g: g.update({name: np.repeat(g[name], 2000, 0) for name in ("pair_obstacles", "pair_own")}),
    ],
)
def test_golden_pairs_are_read_without_trust(change, folder, capfd):
    golden = dict(run_policy.read_safetensors(folder / "golden.safetensors"))
    change(golden)
    resigned(folder, "golden.safetensors", save({name: array.copy() for name, array in golden.items()}))
    assert run_cli("export", "--check", folder) in (2, 3)
    assert run_policy.main([str(folder)]) in (1, 3)
    capfd.readouterr()
