"""The terminal: one kind of table for every command, which leaves out columns before it would cut a cell."""

from __future__ import annotations

import contextlib
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text

from uuvtai.common.exits import plain, say
from uuvtai.report.tables import TERMINAL, Cell, Column, Table, number, obstacles, percent

_PIPE_WIDTH = 160  # [columns] of text that goes into a file: nobody's terminal limits it
_WRAPPED_MIN = 16  # [columns] a column of prose gets at least before others are left out for it
_ENDLESS = 100_000


class Screen:
    """Where results are shown. ``wide`` shows every column, however narrow the terminal; a file is wide in
    any case."""

    def __init__(self, wide: bool = False, console: Console | None = None, more: str = "--wide") -> None:
        """``console``: stdout, unless it is given; ``more``: what shows the columns that have no room."""
        is_terminal = console is not None or (sys.stdout is not None and sys.stdout.isatty())
        self.console = console or Console(width=None if is_terminal else _PIPE_WIDTH)
        self.wide, self._more = wide or not is_terminal, more

    def line(self, text: str | Text, style: str = "") -> None:
        """A line of prose, wrapped between words; no markup."""
        self.console.print(_text(text, style), highlight=False, soft_wrap=False, overflow="fold")

    def table(self, table: Table) -> None:
        """A table with its title; a rule is drawn after each row of its ``sections``.

        Where it is wider than the terminal, the columns of highest ``priority`` are left out and named in a
        line below.
        """
        if table.title:
            self.line(table.title, "italic")
        layout = _Layout(self.console, *table.on(TERMINAL))
        shown, left_out = list(range(len(layout.columns))), []
        while not self.wide and (found := layout.dispensable(shown)) is not None and not layout.fits(shown):
            shown.remove(found)
            left_out.append(found)
        drawn = layout.drawn(shown, "" if self.wide else layout.foldable(shown), table.sections)
        with roomy(self.console, needed(self.console, drawn) if self.wide else 0):
            self.console.print(drawn)
        if left_out:
            names = ", ".join(_head(layout.columns[i]).replace("\n", " ") for i in sorted(left_out))
            self.line(f"left out, for want of room: {names}; {self._more} shows all", "dim")


@dataclass(frozen=True)
class _Layout:
    """Columns and rows of cells of which some may be shown."""

    console: Console
    columns: list[Column]
    rows: list[list[str | Cell]]

    def dispensable(self, shown: Sequence[int]) -> int | None:
        """The column to leave out next: of highest priority, the rightmost of equals; None = all are
        essential."""
        priority, index = max((self.columns[i].priority, i) for i in shown)
        return index if priority > 0 else None

    def fits(self, shown: Sequence[int], folded: str = "") -> bool:
        """Whether these columns have room where prose, and what else is ``folded``, is as narrow as it may
        become."""
        return needed(self.console, self.drawn(shown, "", (), folded)) <= self.console.width

    def foldable(self, shown: Sequence[int]) -> str:
        """What goes on in the next line where it has no room, beside prose: nothing, names, or everything."""
        if self.fits(shown):
            return ""
        return "names" if self.fits(shown, "names") else "all"

    def drawn(
        self, shown: Sequence[int], folded: str, sections: Sequence[int] = (), narrowed: str | None = None
    ) -> RichTable:
        """A cell of a column that folds goes on in the next line, whole; the others keep their width.
        ``narrowed``: to measure, cells of columns that would fold are as narrow as they may become."""
        columns = [self.columns[i] for i in shown]
        has_head = any(column.head for column in columns)
        found = RichTable(box=SIMPLE_HEAD, pad_edge=False, show_edge=False, show_header=has_head)
        for column in columns:
            found.add_column(
                Text(_head(column)),
                justify="left" if column.left or column.prose else "right",
                no_wrap=not _folds(column, folded),
                overflow="fold",
                vertical="top",
            )
        for place, row in enumerate(self.rows):
            cells = [_text(row[i]) for i in shown]
            if narrowed is not None:
                cells = [
                    Text(str(cell)[:_WRAPPED_MIN]) if _folds(column, narrowed) else cell
                    for column, cell in zip(columns, cells, strict=True)
                ]
            found.add_row(*cells, end_section=place in sections)
        return found


@contextlib.contextmanager
def roomy(console: Console, width: int) -> Iterator[None]:
    """Whatever is printed inside has ``width`` columns, though the terminal may have fewer."""
    before = console.width
    console.width = max(before, width)
    try:
        yield
    finally:
        console.width = before


def _folds(column: Column, folded: str) -> bool:
    return column.prose or folded == "all" or (folded == "names" and column.left)


def _head(column: Column) -> str:
    return column.short or column.head


def needed(console: Console, table: RichTable) -> int:
    """[columns] that a table takes where nothing is wrapped."""
    return Measurement.get(console, console.options.update(width=_ENDLESS), table).maximum


def _text(cell: str | Cell | Text, style: str = "") -> Text:
    """As it is: brackets in a file's name are no markup, and nothing in it steers the terminal."""
    if isinstance(cell, Text):
        return cell
    if isinstance(cell, Cell):
        return Text(plain(cell.brief), style=cell.style)
    return Text(plain(cell), style=style)


# ---- How far a job is: a bar on a terminal, a plain line every few seconds elsewhere, and no guess of the
# time left too early.

_PERIOD_S = 5.0  # between two lines where there is no terminal
_WORTH_S = 20.0  # after so long at work the speed so far says something
_WORTH_SHARE = 0.1  # or after this part of the work


class Pace:
    """Time left, from the work done since the clock began. Compiling comes before that and is no part of
    it."""

    def __init__(self, total: float, done: float = 0.0, now: Callable[[], float] = time.perf_counter) -> None:
        """``done`` of ``total`` is over as the clock begins."""
        self._total, self._first, self._now = total, done, now
        self._begun = now()

    @property
    def elapsed_s(self) -> float:
        """Since the clock began [s]."""
        return self._now() - self._begun

    def left_s(self, done: float) -> float | None:
        """Time left [s] where ``done`` is over; None = too early to tell."""
        spent, since, todo = self.elapsed_s, done - self._first, self._total - done
        is_worth_it = spent >= _WORTH_S or since >= _WORTH_SHARE * (self._total - self._first)
        return spent / since * todo if since > 0 and is_worth_it else None


def time_left(left_s: float | None) -> str:
    """'ETA 34 s', 'ETA 5 min', or nothing."""
    if left_s is None:
        return ""
    return f"ETA {left_s:.0f} s" if left_s < 120 else f"ETA {left_s / 60:.0f} min"


class _Told:
    """What stands on a terminal while a job runs: a display of Rich's, or nothing."""

    _live: Any = None

    def note(self, text: str) -> None:
        """A message for the person who waits."""
        if self._live is not None:
            self._live.console.print(Text(plain(text)), highlight=False)
        else:
            say(text)

    def stop(self) -> None:
        """The job is done."""
        if self._live is not None:
            self._live.stop()
            self._live = None


class Progress(_Told):
    """Rich progress with ETA on a terminal, one plain line every few seconds otherwise.

    A job that tells that nothing is done yet, in no steps, is compiling: that is shown, and the clock begins
    with what it tells next.
    """

    def __init__(self, what: str = "episodes") -> None:
        """``what``: of which things a job has so many."""
        self._what = what

    def start(self, name: str, total: int, done: int = 0) -> None:
        """A job of ``total`` things begins, of which ``done`` are over."""
        self._name, self._total, self._done = name, total, done
        self._pace: Pace | None = Pace(total, done)
        self._env_steps = 0
        self._last = time.perf_counter()
        if sys.stderr.isatty():
            self._live = _bar()
            self._live.start()
            self._task = self._live.add_task(name, total=total, completed=done, remark="")

    def update(self, done: int, total: int, env_steps: int = 0, left: int | None = None) -> None:
        """``done`` of ``total`` things are over after ``env_steps`` env steps; ``left``: env steps still to
        come, where that is known."""
        if done == self._done and env_steps == 0:
            self._pace = None
            self._show(done, "compiling")
            return
        if self._pace is None:  # the first pass is over, and with it the compiling
            self._pace, self._done, self._env_steps = Pace(total, done), done, env_steps
        spent, steps = self._pace.elapsed_s, env_steps - self._env_steps
        speed = f"{steps / spent:,.0f} env-steps/s" if steps and spent > 0 else ""
        self._show(
            done, ", ".join(part for part in (speed, time_left(self._left_s(done, env_steps, left))) if part)
        )

    def _left_s(self, done: int, env_steps: int, left: int | None) -> float | None:
        """Time left [s]. Of episodes, from their steps: run together they end together, and their count
        tells nothing until then."""
        assert self._pace is not None
        if not env_steps:
            return self._pace.left_s(done)
        steps = env_steps - self._env_steps
        return self._pace.elapsed_s / steps * left if left is not None and steps > 0 else None

    def _show(self, done: int, remark: str) -> None:
        now = time.perf_counter()
        if self._live is not None:
            self._live.update(self._task, completed=done, remark=remark)
        elif now - self._last >= _PERIOD_S:
            self._last = now
            say(f"{self._name}: {done}/{self._total} {self._what}" + (f", {remark}" if remark else ""))


@contextmanager
def counted(name: str, what: str) -> Iterator[Callable[[int, int], None]]:
    """A call (done, total) that shows a job whose total is known with its first piece."""
    progress = Progress(what)

    def update(done: int, total: int) -> None:
        if done == 1:
            progress.start(name, total)
        progress.update(done, total)

    try:
        yield update
    finally:
        progress.stop()


def _bar():
    """Bar of a job; what it says beside the count is ours: Rich would guess the time left from the first
    moment on."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    return Bar(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[remark]}", markup=False),
        console=Console(stderr=True),
        transient=True,
    )


# ---- A training as it runs: a live dashboard on a terminal, one plain line every few seconds otherwise.

_REDRAW_S = 5.0


class TrainingProgress(_Told):
    """What ``learning.runner`` tells while it runs. The first iteration compiles: it is no part of the speed
    and of the time left."""

    def __init__(self) -> None:
        self._last = 0.0
        self._pace: Pace | None = None
        self._evaluated: dict[str, float] = {}  # newest figures of an evaluation

    def start(self, folder: Path, config: Any, done: int, total: int) -> None:
        """``done`` of ``total`` iterations are over as the run begins in ``folder``."""
        say(f"run folder: {folder}; watch it: tensorboard --logdir {shlex.quote(f'{folder}/tensorboard')}")
        self._folder, self._total, self._pace = folder, total, None
        own = f"{obstacles(config.world.obstacles)}, v = {config.world.dynamic_speed_m_s} m/s"
        worlds = ", ".join(config.worlds)
        self._title = f"{config.train.num_envs} envs, {worlds or own}"
        if sys.stderr.isatty():
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), refresh_per_second=4, transient=False)
            self._live.start()
            self._live.update(Text(f"{self._title}: compiling"))
        else:
            say(f"{self._title}: compiling")

    def update(self, done: int, metrics: dict[str, float], success_ci95: tuple[float, float] | None) -> None:
        """Iteration ``done`` is over."""
        now = time.perf_counter()
        is_first = self._pace is None
        if self._pace is None:
            self._pace = Pace(self._total, done)
        self._evaluated |= {name: value for name, value in metrics.items() if name.startswith("eval/")}
        rows = training_rows(self._evaluated | metrics, success_ci95, self._pace.left_s(done), is_first)
        if self._live is not None:
            self._live.update(
                _dashboard(f"{self._folder}: iteration {done} of {self._total}, {self._title}", rows)
            )
        elif now - self._last >= _REDRAW_S or done == self._total:
            self._last = now
            say(
                f"{done}/{self._total}: " + ", ".join(f"{name} {text}".strip() for name, text in rows.items())
            )


def _dashboard(title: str, rows: dict[str, str]) -> Group:
    table = RichTable(show_header=False, box=None, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, text in rows.items():
        table.add_row(name, Text(text))
    return Group(Text(plain(title), style="italic"), table)


def training_rows(
    metrics: dict[str, float], success_ci95: tuple[float, float] | None, left_s: float | None, is_first: bool
) -> dict[str, str]:
    """What the dashboard shows: name -> text. ``is_first``: the iteration has compiled, so its speed is
    none."""
    of = metrics.get
    interval = f" [{100 * success_ci95[0]:.0f}, {100 * success_ci95[1]:.0f}]" if success_ci95 else ""
    times = {name: of(f"time/{name}_s", 0.0) for name in ("simulate", "infer", "learn")}
    split = " / ".join(
        f"{name} {100 * spent / max(1e-9, sum(times.values())):.0f} %" for name, spent in times.items()
    )
    unit = "decisions" if "time/decisions" in metrics else "env_steps"
    per_s = "" if is_first else f", {of(f'time/{unit}_per_s', 0.0):,.0f}/s ({split})"
    rows = {
        "success": percent(of("rollout/success_rate"), 0) + interval,
        "collision": percent(of("rollout/collision_rate"), 0),
        "reward": number(of("rollout/ep_rew_mean"), 2),
        unit.replace("_", "-"): f"{of(f'time/{unit}', 0.0):,.0f}{per_s}",
    }
    if of("distillation/lambda_risk"):
        rows["distillation weight"] = number(of("distillation/lambda_risk"), 3)
    if left_s is not None:
        rows["ETA"] = time_left(left_s).removeprefix("ETA ")
    if "eval/success_rate" in metrics:
        rows["evaluation"] = (
            f"success {percent(of('eval/success_rate'))}, collision {percent(of('eval/collision_rate'))}"
        )
    return rows
