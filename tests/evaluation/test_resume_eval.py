"""An evaluation that is interrupted or killed goes on, and ends as if nobody had disturbed it."""

import json
import shutil
from pathlib import Path

import pytest

from tests.conftest import configure
from uuvtai.common.errors import UserError
from uuvtai.config.loader import preset_path
from uuvtai.evaluation import results
from uuvtai.evaluation.evaluate import Request, compare, resume
from uuvtai.evaluation.results import REQUEST_FILE as REQUEST
from uuvtai.logs import reader

TIMES = ("wall_s", "env_steps_per_s")
"""of the machine, not of the vehicles"""
EPISODES = 4


class Watch:
    """Interrupts at the ``after``-th finished episode of a agent."""

    def __init__(self, agent=None, after=0):
        self.agent, self.after, self.notes, self.begun = agent, after, [], {}

    def start(self, name, total):
        self.name = name
        self.begun[name] = None

    def note(self, text):
        self.notes.append(text)

    def update(self, done, total, env_steps, left=None):
        if self.begun[self.name] is None:
            self.begun[self.name] = done
        if self.name == self.agent and done >= self.after:
            raise KeyboardInterrupt

    def stop(self):
        pass


@pytest.fixture(scope="module")
def ask(small, tmp_path_factory):
    """Requests of the session's simulator; the blind oracle drives, twice. Its second episode is over before
    the horizon."""
    episode = small.config.episode.model_copy(update={"horizon_steps": 125})
    config = small.config.model_copy(update={"episode": episode})
    second = tmp_path_factory.mktemp("trees") / "second.xml"
    second.write_text(preset_path("tree", "straight").read_text())

    def request(folder, **others):
        given = {
            "agents": ["straight", str(second)], "episodes": EPISODES, "seeds": [3], "num_envs": 2,
            "device": "cpu", "record": 2,
        }  # fmt: skip
        return Request(config=config, world="pool", sensors="paper", run_dir=folder, **given | others)

    with pytest.MonkeyPatch.context() as patch:
        configure(patch, small.sim, config)
        patch.setattr("uuvtai.evaluation.evaluate._draw", lambda *_arguments: None)
        patch.setattr(
            "uuvtai.sim.sim.Sim",
            lambda _config, _num_envs, tree, _device: small.sim.use_tree(tree) or small.sim,
        )
        yield request
    small.sim.use_tree(small.trees["bt"])


def outcome(result):
    """A document without the machine's times."""
    return result | {
        "agents": [{name: value for name, value in m.items() if name not in TIMES} for m in result["agents"]]
    }


@pytest.fixture(scope="module")
def whole(ask, tmp_path_factory):
    return compare(ask(tmp_path_factory.mktemp("whole") / "run"), Watch())


@pytest.mark.parametrize(("agent", "after"), [("straight", 1), ("second", 2)])
def test_an_interrupted_evaluation_ends_as_an_undisturbed_one(ask, whole, tmp_path, agent, after):
    run, watch = tmp_path / "run", Watch(agent, after)
    with pytest.raises(KeyboardInterrupt):
        compare(ask(run), watch)
    assert f"finished episodes are kept; go on with: uuv eval --resume {run}" in watch.notes
    assert json.loads((run / "run.json").read_text())["status"] == "interrupted"
    assert not (run / "eval/result.json").exists()
    kept = (run / results.JOURNAL_FILE).read_bytes()
    finished = sum(json.loads(line)["agent"] == agent for line in kept.splitlines())
    assert after <= finished <= EPISODES
    old = {log.name: log.stat().st_mtime_ns for log in (run / "logs").glob("*.mcap")}
    watch = Watch()
    result, _ = resume(run, watch)
    assert outcome(result) == outcome(whole[0])
    assert json.loads((run / "eval/result.json").read_text()) == result
    assert (run / "eval/tree.json").read_bytes() == (whole[1] / "eval/tree.json").read_bytes()
    assert (run / results.JOURNAL_FILE).read_bytes().startswith(kept), "nothing that is over is run again"
    assert watch.begun[agent] is None or watch.begun[agent] >= finished
    logs = sorted((run / "logs").iterdir())
    assert [log.name for log in logs] == sorted(log.name for log in (whole[1] / "logs").iterdir()), (
        "every log whole, no part left"
    )
    assert all((run / "logs" / name).stat().st_mtime_ns == time for name, time in old.items()), (
        "finished logs are kept"
    )
    assert all(reader.info(log)["outcome"] for log in logs)


def test_a_line_that_a_kill_cut_off_and_a_lost_log_are_played_again(ask, whole, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        compare(ask(run), Watch("second", EPISODES))
    file = run / results.JOURNAL_FILE
    file.write_bytes(file.read_bytes()[:-30])
    next((run / "logs").glob("straight*.mcap")).unlink()
    result, _ = resume(run, Watch())
    assert outcome(result) == outcome(whole[0])
    assert len(list((run / "logs").glob("*.mcap"))) == 4
    again, _ = resume(run, Watch())
    assert outcome(again) == outcome(result), "a finished one is told again"


def interrupted(ask, run, **others):
    with pytest.raises(KeyboardInterrupt):
        compare(ask(run, **others), Watch("straight" if "agents" not in others else "mine", 1))


@pytest.fixture(scope="module")
def cut(ask, tmp_path_factory):
    """The folder of an interrupted evaluation."""
    run = tmp_path_factory.mktemp("cut") / "run"
    interrupted(ask, run, record=0)
    return run


def test_another_tree_under_the_same_name_is_refused(ask, tmp_path):
    tree = tmp_path / "mine.xml"
    tree.write_text(preset_path("tree", "straight").read_text())
    run = tmp_path / "run"
    interrupted(ask, run, agents=[str(tree)], record=0)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    tree.write_text(preset_path("tree", "planner").read_text())
    with pytest.raises(UserError, match="mine has changed since this evaluation began"):
        resume(run, Watch())
    assert before == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        (REQUEST, b"{", "is no request"),
        (REQUEST, b"[1]", "is no request"),
        (REQUEST, b'{"schema": 1, "controllers": ["bt"]}', "is no request of this version of 'uuv eval'"),
        (REQUEST, None, "cannot be read"),
        (results.JOURNAL_FILE, b'{"agent": "straight"}\n', "line 1: is no finished episode"),
        (results.JOURNAL_FILE, b"\xff\xfe\n", "line 1: is no finished episode"),
    ],
)
def test_a_damaged_folder_is_refused(cut, tmp_path, file, content, says):
    run = shutil.copytree(cut, tmp_path / "run")
    (run / file).unlink()
    if content is not None:
        (run / file).write_bytes(content)
    with pytest.raises(UserError, match=says):
        resume(run, Watch())


def test_a_ledger_that_is_a_link_is_not_written_through(cut, tmp_path):
    run, victim = shutil.copytree(cut, tmp_path / "run"), tmp_path / "victim"
    victim.write_text("mine, without an end of line")
    (run / results.JOURNAL_FILE).unlink()
    (run / results.JOURNAL_FILE).symlink_to(victim)
    with pytest.raises(UserError, match="is a link"):
        resume(run, Watch())
    assert victim.read_text() == "mine, without an end of line"


def test_paths_of_the_request_are_found_from_another_folder(ask, tmp_path, monkeypatch):
    (tmp_path / "mine.xml").write_text(preset_path("tree", "straight").read_text())
    monkeypatch.chdir(tmp_path)
    interrupted(ask, Path("run"), agents=["mine.xml"], record=0)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    result, _ = resume(tmp_path / "run", Watch())
    assert [agent["name"] for agent in result["agents"]] == ["mine"]


def test_a_folder_of_something_else_is_refused(tmp_path):
    with pytest.raises(
        UserError, match=r"has no plain file run\.json; give the folder that 'uuv eval' printed"
    ):
        resume(tmp_path, Watch())
