"""Entries of a benchmark: written by a play, read from anybody, checked by a replay."""

import json
import sys
from pathlib import Path

import pytest

from tests.command import uuv
from tests.test_resume_eval import Watch
from uuvtai.errors import SettingError, UserError
from uuvtai.files import FileError
from uuvtai.loader import ConfigError, load_config
from uuvtai.measure.benchmark import benchmark_scenes, entering, entry_file, fingerprints, verifying
from uuvtai.measure.benchmark.benchmark_scenes import BenchmarkScene, scenes_of
from uuvtai.measure.benchmark.entering import BenchmarkRequest, enter
from uuvtai.measure.benchmark.entrant import Entrant, entrant_of
from uuvtai.measure.benchmark.entry_file import EntryError, read_entry
from uuvtai.measure.benchmark.fingerprints import piece_files, sealed, sources_sha256
from uuvtai.measure.benchmark.verifying import verify
from uuvtai.measure.evaluate.scenario_digest import scenarios_sha256
from uuvtai.measure.reproduce.steps import RETIRED_SEEDS
from uuvtai.own.piece_spec import piece_spec
from uuvtai.tables.benchmark_tables import counts_of

TINY = BenchmarkScene("tiny", "pool", 8, 6, 0.6, "the tests' own", ("world.dynamic_capacity=9",))
AWAY = (
    "import numpy as np\nimport beside\n\n"
    "def act(view):\n    return np.tile([0.6, 0.0, 0.0, 0.0], (len(view.rows), 1))\n"
)


@pytest.fixture
def bench(small, monkeypatch, tmp_path):
    """The session's simulator as the only benchmark's scene, three episodes; a folder to work in."""
    monkeypatch.setattr(benchmark_scenes, "SCENES", (TINY,))
    monkeypatch.setattr(benchmark_scenes, "NAMES", ("tiny", "all"))
    for module in (entering, entry_file):
        monkeypatch.setattr(module, "EPISODES", 3)
        monkeypatch.setattr(module, "TRIAL_EPISODES", 2)
    monkeypatch.setattr(
        "uuvtai.sim.Sim", lambda _config, _num_envs, tree, _device: small.sim.use_tree(tree) or small.sim
    )
    whole = small.sim.reset

    def late(mask, seed, number):
        """Episodes are short."""
        whole(mask, seed, number)
        for row in mask.nonzero().flatten().tolist():
            small.sim.s.clock.step[row] = small.config.episode.horizon_steps - 40

    monkeypatch.setattr(small.sim, "reset", late)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    small.sim.planner = None
    small.sim.use_tree(small.trees["bt"])


def entered(name="straight", **more):
    entry, folder = enter(BenchmarkRequest("tiny", Entrant(name), run_dir=Path("run"), **more), Watch())
    assert folder == Path("run")
    return entry, folder / entering.FILE


def changed(file, change):
    """Another file with the entry as ``change`` leaves it, sealed as its author would."""
    document = json.loads(file.read_text())
    change(document)
    other = file.with_name("changed.json")
    other.write_text(json.dumps(sealed(document)))
    return other


def failed(document):
    return [check["name"] for check in document["checks"] if not check["ok"] and not check["is_told"]]


# --------------------------------------------------------------------------------------------- the scenes


@pytest.mark.parametrize("scene", benchmark_scenes.SCENES, ids=lambda scene: scene.name)
def test_a_scene_is_what_its_row_says(scene):
    config = scene.config()
    assert (config.world.n_static, config.world.n_dynamic) == (scene.n_static, scene.n_dynamic)
    assert scene.speed_m_s in (None, config.world.dynamic_speed_m_s)
    assert (scene.speed_m_s is None) == (scene.n_dynamic == 0)
    assert config.sensors == load_config("pool", "paper").sensors


def test_scenes_are_fixed():
    """Whoever changes what an episode is, changes these: raise ``VERSION``, old entries are of another
    benchmark."""
    assert benchmark_scenes.VERSION == 1 and benchmark_scenes.SEED == 91001
    world = load_config("crossing").world
    assert (world.n_static, world.n_dynamic, world.start_goal_gap_m) == (10, 0, 12.0)
    assert benchmark_scenes.SEED not in (*RETIRED_SEEDS, 90007, 90008, 77001, 77002)
    own = load_config("netpen").world
    assert [(s.n_static, s.n_dynamic) for s in scenes_of("netpen")] == [(own.n_static, own.n_dynamic)]
    assert len(scenes_of("all")) == 7


def test_names_that_are_none_are_refused():
    with pytest.raises(ConfigError, match="'pol' is no benchmark; did you mean 'pool'"):
        scenes_of("pol")
    with pytest.raises(SettingError, match="bt, planner: an entry is of one pilot"):
        entrant_of([], ["bt", "planner"])
    with pytest.raises(SettingError, match="nobody: an entry is of one pilot"):
        entrant_of([], [])
    for name in ("oracle", "bt+truth"):
        with pytest.raises(SettingError, match="knows the truth"):
            Entrant(name).method(load_config("pool"), Watch())
    assert Entrant("residual", True).is_shipped and Entrant("capped").is_shipped
    assert not Entrant("controller:mine.py:act").is_shipped
    assert Entrant("controller:mine.py:act").typed == "--controller mine.py:act"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["pool", "entry.json"], "uuv benchmark verify entry.json"),
        (["verify"], "which entry"),
        (["verify", "e.json", "--quick"], "not with verify"),
        (["verify", "e.json", "--sample", "-1"], "must be at least 0"),
        (["pool", "--sample", "3"], "belongs to verify"),
        (["pool", "--num-envs", "0"], "must be at least 1"),
        (["pool", "--controller", "bt", "--policy", "best"], "an entry is of one pilot"),
        (["nowhere"], "is no benchmark"),
        (["verify", "missing.json"], "missing.json: cannot be read"),
    ],
)
def test_words_that_do_not_go_together_are_refused(words, says, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _out, err = uuv(capfd, "benchmark", *words)
    assert code == 2 and says in " ".join(err.split())
    assert list(tmp_path.iterdir()) == []


def test_alone_it_lists_what_there_is(capfd):
    code, out, _err = uuv(capfd, "benchmark")
    assert code == 0 and all(scene.name in out for scene in benchmark_scenes.SCENES)
    code, out, _err = uuv(capfd, "benchmark", "--json")
    assert [row["name"] for row in json.loads(out)["benchmarks"]] == list(benchmark_scenes.NAMES[:-1])


# ------------------------------------------------------------------------------------------------ entries


def test_an_entry_says_what_was_played_and_by_whom(bench, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["uuv", "benchmark", "tiny", "--controller", "straight"])
    entry, file = entered()
    assert json.loads(file.read_text()) == entry
    (scene,) = entry["scenes"]
    assert [row[0] for row in scene["episodes"]] == [0, 1, 2] and scene["seed"] == 91001
    assert sum(scene["outcomes"].values()) == 3 and entry["is_entry"]
    assert entry["command"] == "uuv benchmark tiny --controller straight"
    assert entry["pilot"]["name"] == "straight" and entry["pilot"]["is_shipped"]
    assert entry["code"]["sha256"] == sources_sha256() and "cores" in entry["machine"]
    result = json.loads((bench / "run/tiny/eval/result.json").read_text())
    assert scene["scenarios_sha256"] == result["scenarios_sha256"]
    assert counts_of(scene)["success_rate"] == result["methods"][0]["success_rate"]


def test_an_honest_entry_agrees_with_its_replay(bench):
    _, file = entered()
    found = verify(file, None, Watch(), sample=2)
    assert found["ok"] and failed(found) == []
    (replay,) = found["replays"]
    assert (replay["agree"], replay["episodes"], len(set(replay["numbers"]))) == (2, 2, 2)
    assert verify(file, None, Watch(), sample=0)["replays"] == []


def test_a_quick_look_says_that_it_is_no_entry(bench, capfd):
    entry, file = entered(quick=True)
    assert not entry["is_entry"] and entry["scenes"][0]["seed"] == benchmark_scenes.TRIAL_SEED
    assert not verify(file, None, Watch())["is_entry"]
    code, out, _err = uuv(capfd, "benchmark", "verify", file)
    assert code == 0 and "a quick look, no entry" in out
    with pytest.raises(EntryError, match="its seed is 77001, not 91001"):
        read_entry(changed(file, lambda document: document.update(is_entry=True)))


def test_outcomes_that_were_made_up_are_found_by_the_replay(bench, capfd):
    _, file = entered()

    def better(document):
        (scene,) = document["scenes"]
        scene["episodes"] = [[row[0], "success", 10.0, 0.5, 8.0] for row in scene["episodes"]]
        scene["outcomes"] = dict.fromkeys(scene["outcomes"], 0) | {"success": 3}

    code, out, _err = uuv(capfd, "benchmark", "verify", changed(file, better))
    assert code == 3 and "success after 10.00 s, closest 0.500 m in the entry" in " ".join(out.split())
    assert "does not agree" in out


def test_another_config_and_another_pilot_are_told_apart(bench):
    _, file = entered()
    other = changed(file, lambda document: document["scenes"][0].update(config_sha256="0" * 64))
    assert failed(verify(other, None, Watch(), sample=0)) == ["config of tiny"]
    assert failed(verify(file, Entrant("planner"), Watch(), sample=0)) == ["pilot"]
    code = changed(file, lambda document: document["code"].update(sha256="0" * 64))
    found = verify(code, None, Watch(), sample=1)
    assert found["ok"] and [check["ok"] for check in found["checks"] if check["name"] == "code"] == [False]


def test_code_of_the_author_runs_only_where_it_is_named(bench):
    (bench / "mine.py").write_text(AWAY)
    (bench / "beside.py").write_text("x = 1\n")
    entry, file = entered("controller:mine.py:act")
    assert set(entry["pilot"]["files"]) == {"mine.py", "beside.py"}
    with pytest.raises(SettingError, match="does not come with uuvtai; get its files, look at them"):
        verify(file, None, Watch())
    own = Entrant("controller:mine.py:act")
    assert verify(file, own, Watch(), sample=1)["ok"]
    (bench / "beside.py").write_text("x = 2\n")
    assert failed(verify(file, own, Watch(), sample=0)) == ["pilot's files"]
    lies = changed(file, lambda document: document["pilot"].update(is_shipped=True))
    with pytest.raises(SettingError, match="does not come with uuvtai"):
        verify(lies, None, Watch())


# --------------------------------------------------------------------------------------------- a stranger's


@pytest.fixture
def file(bench):
    return entered()[1]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d.update(benchmark_version=2), "is of version 2 of the benchmark"),
        (lambda d: d.update(benchmark="nowhere"), "is no benchmark"),
        (lambda d: d.update(columns=["a"]), "its columns are not"),
        (lambda d: d["scenes"].append(d["scenes"][0]), "its scenes are not those of tiny, each once"),
        (lambda d: d["scenes"][0].update(name="pool"), "its scenes are not those of tiny"),
        (lambda d: d["scenes"][0]["episodes"].pop(), "its episodes are not 0 to 2"),
        (lambda d: d["scenes"][0]["outcomes"].update(success=3), "its counts are not those of its episodes"),
        (lambda d: d["scenes"][0]["episodes"][0].__setitem__(2, 10.013), "no whole number of steps"),
        (lambda d: d["scenes"][0]["episodes"][0].__setitem__(3, "far"), "is no entry of a benchmark"),
        (lambda d: d["scenes"][0]["episodes"][0].__setitem__(1, "won"), "is no entry of a benchmark"),
        (lambda d: d["scenes"][0].update(seed=True), "is no entry of a benchmark"),
        (lambda d: d.update(more=1), "more: Extra inputs are not permitted"),
        (lambda d: d["pilot"].update(name="x" * 400), "is no entry of a benchmark"),
        (lambda d: d["pilot"].update(files={str(i): "0" * 64 for i in range(300)}), "is no entry"),
        (lambda d: d["code"].pop("sha256"), "code.sha256: Field required"),
    ],
)
def test_a_crafted_entry_is_refused_with_the_reason(file, change, says):
    with pytest.raises(UserError) as refused:
        read_entry(changed(file, change))
    assert says in str(refused.value)


def test_an_entry_that_was_changed_by_hand_is_refused(file):
    file.write_text(file.read_text().replace('"straight"', '"planner"', 1))
    with pytest.raises(EntryError, match="was changed after it was written"):
        read_entry(file)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"{",
        b'{"schema": 1}',
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"seal": NaN}',
        b"1e999",
        b"nu\x00ll",
    ],
)
def test_what_is_no_entry_is_refused(content, tmp_path):
    path = tmp_path / "entry.json"
    path.write_bytes(content)
    with pytest.raises((EntryError, FileError)):
        read_entry(path)


def test_large_files_folders_and_pipes_are_refused(tmp_path):
    large = tmp_path / "large.json"
    large.write_bytes(b" " * (entry_file.MAX_BYTES + 1))
    for path in (large, tmp_path):
        with pytest.raises(UserError):
            read_entry(path)


def test_a_name_that_would_steer_the_terminal_does_not(file, capfd):
    other = changed(file, lambda d: d["pilot"].update(name="\x1b[2Jevil; rm -rf ~", typed="$(reboot)"))
    code, out, err = uuv(capfd, "benchmark", "verify", other)
    assert code == 2 and "\x1b" not in out + err and "reboot" not in out + err


# ------------------------------------------------------------------------------------------- fingerprints


def test_a_fingerprint_sees_every_change(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text("def act(view): ...\n")
    (tmp_path / "net").mkdir()
    (tmp_path / "net/weights.bin").write_bytes(b"1")
    monkeypatch.chdir(tmp_path)
    spec = piece_spec("mine.py:load=net", "policy")
    before = piece_files(spec)
    assert set(before) == {"mine.py", "net/weights.bin"}
    (tmp_path / "net/weights.bin").write_bytes(b"2")
    assert piece_files(spec)["net/weights.bin"] != before["net/weights.bin"]
    monkeypatch.setattr(fingerprints, "_MAX_FILES", 1)
    with pytest.raises(FileError, match="brings more than 1 files"):
        piece_files(spec)


def test_scenarios_are_equal_to_the_millimetre():
    one = [{"start": [1.0, 2.0], "bodies": [], "faults": 0}]
    assert scenarios_sha256(one) == scenarios_sha256([{"faults": 0, "bodies": (), "start": [1.0002, 1.9999]}])
    assert scenarios_sha256(one) != scenarios_sha256([{**one[0], "start": [1.001, 2.0]}])
    assert scenarios_sha256([{"z": -0.0001}]) == scenarios_sha256([{"z": 0.0}])


def test_a_sample_is_drawn_by_chance():
    assert verifying.SAMPLE < benchmark_scenes.EPISODES


ENTRIES = sorted((Path(__file__).parents[1] / "docs/data/benchmark").glob("*.json"))


@pytest.mark.parametrize("path", ENTRIES, ids=lambda path: path.stem)
def test_the_entries_of_the_page_are_whole(path):
    entry = read_entry(path)
    assert entry.is_entry and entry.pilot.name == path.stem
    assert [scene.name for scene in entry.scenes] == [scene.name for scene in benchmark_scenes.SCENES]


def test_the_page_has_an_entry_for_each_row():
    assert {path.stem for path in ENTRIES} >= {"bt", "best", "planner", "straight"}
