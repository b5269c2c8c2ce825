"""``uuv eval --explain``: the causes of failures in the document, and logs of the worst."""

from __future__ import annotations

from typing import Any

from uuvtai.measure.evaluate.method_run import Comparison, MethodRun
from uuvtai.measure.explain import failures
from uuvtai.run_folder import RunFolder


def explain(comparison: Comparison, runs: list[MethodRun], result: dict[str, Any], folder: RunFolder) -> None:
    """Replay what failed, add the causes to the document, record the worst. What is known is written before
    the next long step begins."""
    rows = {method_run.method.name: _explained(comparison, method_run) for method_run in runs}
    _write_causes(folder, result)
    for method_run in runs:
        method, entry = method_run.method, method_run.entry
        found = rows[method.name]
        chosen = failures.chosen_for_recording(found, comparison.request.explain_record)
        paths = failures.record_worst(
            comparison.simulator_for(method),
            chosen,
            folder.path / "explain",
            comparison.request.world,
            method.name,
            comparison.watch.note,
            method_run.policy,
            list(rows),
        )
        for row, path in zip(chosen, paths, strict=True):
            entry["explain"][found.index(row)]["log"] = str(path.relative_to(folder.path))
    _write_causes(folder, result)


def _explained(comparison: Comparison, method_run: MethodRun) -> list[failures.Row]:
    """A method's failures with their explanations, which its entry then holds too."""
    policy, watch, name = method_run.policy, comparison.watch, method_run.method.name
    watch.start(f"{name}: replaying failures", len(failures.failures(method_run.results)))
    rows = failures.explain_failures(
        comparison.simulator_for(method_run.method),
        method_run.results,
        watch.update,
        policy.pilot if policy else None,
        method_run.method.own is not None,
    )
    watch.stop()
    if lost := len(failures.failures(method_run.results)) - len(rows):
        watch.note(
            f"{name}: {lost} failures ended otherwise when they were played again and are not explained: "
            "your code depends on more than it is shown (random numbers, the clock, older episodes)"
        )
    method_run.entry["causes"] = failures.table_of(rows)
    method_run.entry["explain"] = [row.document() for row in rows]
    return rows


def _write_causes(folder: RunFolder, result: dict[str, Any]) -> None:
    folder.write_json("eval/result.json", result)
    methods = [
        {"name": entry["name"], "causes": entry["causes"], "explain": entry["explain"]}
        for entry in result["methods"]
        if "explain" in entry
    ]
    folder.write_json("eval/explain.json", {"schema": 1, "methods": methods})
