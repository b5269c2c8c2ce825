"""``uuv benchmark verify``: the hashes of an entry, and a sample of its episodes played again."""

from __future__ import annotations

import random
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uuvtai.errors import SettingError
from uuvtai.measure.benchmark.benchmark_scenes import BenchmarkScene
from uuvtai.measure.benchmark.entering import BATCH
from uuvtai.measure.benchmark.entrant import Entrant, sha256_of_method
from uuvtai.measure.benchmark.entry_file import Entry, PlayedScene, read_entry, scenes_by_name
from uuvtai.measure.benchmark.fingerprints import condition_sha256, sources_sha256
from uuvtai.shipped import preset_names

if TYPE_CHECKING:
    from uuvtai.measure.episodes.methods import Method
    from uuvtai.measure.episodes.playing import EpisodeResult
    from uuvtai.measure.evaluate.method_run import EvaluationWatch
    from uuvtai.sim import Sim

SAMPLE = 8
"""episodes of each scene that are played again"""
_NEAR = (1e-3, 1e-3, 1e-3)
"""how far a replay may be off before it is another episode: time [s], clearance [m], path [m]"""

Check = dict[str, Any]
_EpisodeRow = tuple[int, str, float, float, float]


@dataclass(frozen=True)
class _Replay:
    """Who plays, and on what."""

    entrant: Entrant
    method: Method
    device: str
    watch: EvaluationWatch

    def simulator(self, bench: BenchmarkScene) -> Sim:
        """A scene's simulator, observed as the pilot was trained."""
        from uuvtai.measure.evaluate.eval_request import Request
        from uuvtai.sim import Sim

        who = self.entrant.asked()
        request = Request.typed(
            bench.options(), who["policies"], controllers=who["controllers"], seeds=[0],
            episodes=1, device=self.device,
        )  # fmt: skip
        return Sim(self.method.config_of(request.config), BATCH, self.method.tree, self.device)

    def play(self, sim: Sim, played: PlayedScene, numbers: list[int], name: str) -> list[EpisodeResult]:
        """These episodes once more."""
        from uuvtai.measure.episodes.playing import Job, run_episodes

        note, sim.planner = self.method.driver_for(sim), self.method.planner_for(sim)
        self.watch.start(f"{name}: {self.method.name}", len(numbers))
        try:
            jobs = [Job(played.seed, number) for number in numbers]
            return run_episodes(sim, jobs, None, self.watch.update, note.pilot if note else None)[0]
        finally:
            self.watch.stop()
            if self.method.own:
                self.method.own.close()


def verify(
    file: Path, entrant: Entrant | None, watch: EvaluationWatch, sample: int = SAMPLE, device: str = "auto"
) -> dict[str, Any]:
    """Check an entry; the document of ``uuv benchmark verify --json``.

    ``entrant``: who shall play, from the user's own disk; without one a pilot that is shipped plays, and
    whatever else an entry names is never run. ``sample`` episodes of each scene are drawn by chance. Hashes
    of the code and of the scenarios are told, but do not decide: on another machine numbers round otherwise.
    Nor does that of the config where the code is another one, which may have more keys: the replay does.
    Raises EntryError, FileError for a file that is refused, SettingError where the pilot must be given.
    """
    entry = read_entry(file)
    pairs = scenes_by_name(entry)
    player = entrant or _shipped(file, entry)
    method = player.method(next(iter(pairs.values()))[0].config(), watch)
    checks = [
        _check("form, seal, counts", True, "in order"),
        _same("code", entry.code.sha256, sources_sha256(), f"uuvtai {entry.code.version}")
        | {"is_told": True},
        _same("pilot", entry.pilot.sha256, sha256_of_method(method), player.typed),
    ]
    is_other = not checks[1]["ok"]
    replays = []
    for bench, played in pairs.values():
        found, replay = _scene(bench, played, _Replay(player, method, device, watch), sample)
        checks += [check | {"is_told": check["is_told"] or is_other} for check in found]
        replays += [replay] if replay["episodes"] else []
    checks += _files(entry, player)
    agree = all(replay["agree"] == replay["episodes"] for replay in replays)
    return {
        "schema": 1,
        "file": str(file),
        "benchmark": entry.benchmark,
        "is_entry": entry.is_entry,
        "pilot": entry.pilot.name,
        "machine": entry.machine,
        "code_version": entry.code.version,
        "checks": checks,
        "replays": replays,
        "ok": agree and all(check["ok"] or check["is_told"] for check in checks),
    }


def _shipped(file: Path, entry: Entry) -> Entrant:
    """The pilot of an entry whose name is one of a shipped one. SettingError for every other: code and files
    are run because the user names them, never because a file does."""
    name = entry.pilot.name
    for kind, is_trained in (("tree", False), ("stack", False), ("policy", True)):
        if entry.pilot.is_shipped and name in preset_names(kind):
            return Entrant(name, is_trained)
    raise SettingError(
        f"{file}: its pilot {name!r} does not come with uuvtai; get its files, look at them, and name them "
        f"behind the file: --controller FILE.py:NAME, --planner FILE.py:NAME or --policy FILE"
    )


def _scene(
    bench: BenchmarkScene, played: PlayedScene, replay: _Replay, sample: int
) -> tuple[list[Check], dict[str, Any]]:
    """Checks of one scene, and what became of its sample."""
    ours = condition_sha256(bench.config())
    checks = [_same(f"config of {bench.name}", played.config_sha256, ours, "the scene's settings")]
    numbers = sorted(
        random.SystemRandom().sample(range(len(played.episodes)), min(sample, len(played.episodes)))
    )
    differences = []
    if numbers:
        sim = replay.simulator(bench)
        results = replay.play(sim, played, numbers, bench.name)
        checks.append(_scenarios(bench, played, sim))
        rows = [(played.episodes[result.episode], _row(result)) for result in results]
        differences = [
            {"episode": ours[0], "entry": _shown(theirs), "here": _shown(ours)}
            for theirs, ours in rows
            if not _is_same(theirs, ours)
        ]
    agree = len(numbers) - len(differences)
    counts = {"episodes": len(numbers), "agree": agree, "differences": differences}
    return checks, {"scene": bench.name, "numbers": numbers, **counts}


def _scenarios(bench: BenchmarkScene, played: PlayedScene, sim: Sim) -> Check:
    from uuvtai.measure.episodes.playing import jobs_of
    from uuvtai.measure.evaluate.ceilings import scenarios_of
    from uuvtai.measure.evaluate.scenario_digest import scenarios_sha256

    drawn = scenarios_sha256(scenarios_of(sim, jobs_of([played.seed], len(played.episodes))))
    found = _same(f"scenarios of {bench.name}", played.scenarios_sha256, drawn, "another machine or version")
    return found | {"is_told": True}


def _check(name: str, ok: bool, detail: str) -> Check:
    """``is_told``: said, but it does not decide."""
    return {"name": name, "ok": ok, "detail": detail, "is_told": False}


def _same(name: str, theirs: str, ours: str, what: str) -> Check:
    detail = "the same" if theirs == ours else f"{theirs[:12]} in the entry, {ours[:12]} here ({what})"
    return _check(name, theirs == ours, detail)


def _files(entry: Entry, entrant: Entrant) -> list[Check]:
    """A check of the pilot's own files; none where it has none."""
    if not entry.pilot.files:
        return []
    ours = entrant.files()
    other = [name for name, sha256 in entry.pilot.files.items() if ours.get(name) != sha256]
    return [
        _check("pilot's files", not other, f"not the entry's: {', '.join(other)}" if other else "the same")
    ]


def _row(result: EpisodeResult) -> _EpisodeRow:
    return result.episode, result.outcome, result.time_s, result.min_clearance_m, result.path_length_m


def _is_same(theirs: _EpisodeRow, ours: _EpisodeRow) -> bool:
    close = (abs(a - b) <= most for a, b, most in zip(theirs[2:], ours[2:], _NEAR, strict=True))
    return theirs[:2] == ours[:2] and all(close)


def _shown(row: _EpisodeRow) -> str:
    return f"{row[1]} after {row[2]:.2f} s, closest {row[3]:.3f} m"
