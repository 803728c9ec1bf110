"""How far a command has come: a bar with the most time left on a terminal, now and then a line elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from threading import Event, Thread, Timer

from rich.progress import BarColumn, ProgressColumn, SpinnerColumn, Task, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.text import Text

from seaopt.cli.terminal import Terminal
from seaopt.formatting import printable
from seaopt.progress import Progress

LABELS = {
    "simulate": "simulating",
    "frf": "frequency responses",
    "fit": "fitting the logs",
    "tune": "tuning the controller",
    "sweep": "tuning at every bandwidth",
    "certify": "certifying",
    "report": "writing the report",
}
SHOWN_AFTER_S = 2.0  # a stage that is done before shows no progress
LEAST_SHARE = 0.02  # of a stage, from which what is left can be told
# CAUTION: times what the measured speed makes of the remaining share; MOST: times what was spent, for which is told
CAUTION, MOST = 2.5, 5.0
WRONG = 2.0  # times what is left of what was told, from which another number is told
RECENT, LEAST_RECENT_S = 0.25, 2.0  # of the time spent: the part whose speed counts by itself
MOST_NOTE = 30  # characters beside the bar, in a terminal of 80
REPORT_S = 30.0  # between lines of progress that go to a file


class TimeLeft:
    """At most how long a stage still takes, by the speed of all of it or of its last part, whichever is slower.

    A stage may turn slow late: a fit that is done searching in a second looks for causes for half a minute. So what is
    measured is taken with caution, what is left takes at least as long as the longest part did, and where it is more
    than was told before nothing is told, unless it is `WRONG` times as much or that time has passed: the number only
    falls, but for one that was wrong. Nothing is told before the share `told_from`: what comes before has no scale.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, told_from: float = LEAST_SHARE) -> None:
        self._clock, self._told_from = clock, told_from
        self._marks = [(clock(), 0.0)]
        self._longest, self._end = 0.0, math.inf

    def move(self, share: float) -> None:
        """Note the share that is done now."""
        now, (last, before) = self._clock(), self._marks[-1]
        if before >= self._told_from:
            self._longest = max(self._longest, now - last)
        self._marks.append((now, share))

    def tell(self) -> str:
        """Return what to say; empty where it cannot be told."""
        now, marks = self._clock(), list(self._marks)  # others may move it meanwhile
        (started, _), (last, share) = marks[0], marks[-1]
        part = max(RECENT * (now - started), LEAST_RECENT_S)
        since, before = next((mark for mark in reversed(marks) if mark[0] <= last - part), marks[0])
        if share < self._told_from or not before < share < 1.0:
            return ""
        slowness = max((last - started) / share, (last - since) / (share - before))
        silent = now - last  # what is silent for longer than was told takes longer
        end = now + CAUTION * max((1.0 - share) * slowness - silent, self._longest - silent, silent)
        wrong = end - now > WRONG * (self._end - now)  # what was told; also where it has passed
        if (end > self._end and not wrong) or end - now > MOST * (now - started):
            return ""
        self._end = end
        left_s = end - now
        if left_s > 90.0:
            return f"at most {math.ceil(left_s / 60.0)} min left"
        return f"at most {10 * math.ceil(left_s / 10.0)} s left"


class _Left(ProgressColumn):
    """What is left of a stage, as it is when it is drawn."""

    def render(self, task: Task) -> Text:
        return Text(task.fields["left"].tell())


@contextmanager
def show_progress(
    console: Terminal, label: str, note: Callable[[str], None], *, brief: bool = False, told_from: float = LEAST_SHARE
) -> Generator[Progress]:
    """Show a stage's progress on a terminal, with the time left; elsewhere write lines. Remarks go to `note`, and stay.
    A stage that ends in an error is not done. Of a `brief` one nothing is written where it ends before the first line.
    The time left is told from the share `told_from`.
    """
    if not console.is_terminal:
        with _write_progress(console, label, note, brief=brief, told_from=told_from) as tell:
            yield tell
        return
    columns = (
        SpinnerColumn(), TextColumn("{task.description:<22}"), BarColumn(bar_width=12), TimeElapsedColumn(),
        _Left(), TextColumn("{task.fields[note]}", style="dim"),
    )  # fmt: skip
    left = TimeLeft(told_from=told_from)
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task(label, total=1.0, note="", left=left, visible=False)

        def show(text: str, share: float | None = None, /) -> None:
            if share is None:
                note(text)
                return
            left.move(share)
            beside = printable(text)
            beside = beside if len(beside) <= MOST_NOTE else f"{beside[: MOST_NOTE - 1]}…"
            bar.update(task, completed=share, note=beside)

        timer = Timer(SHOWN_AFTER_S, lambda: bar.update(task, visible=True))
        timer.daemon = True
        timer.start()
        try:
            yield show
        finally:
            timer.cancel()


@contextmanager
def _write_progress(
    console: Terminal, label: str, note: Callable[[str], None], *, brief: bool, told_from: float
) -> Generator[Progress]:
    """Write a line every REPORT_S while a stage runs, whether or not it tells anything, and one when it is done."""
    latest, ended, started, left = "", Event(), time.monotonic(), TimeLeft(told_from=told_from)

    def tell(text: str, share: float | None = None, /) -> None:
        nonlocal latest
        if share is None:
            note(text)
        else:
            latest = text
            left.move(share)

    def write_lines() -> None:
        with suppress(OSError):  # a stderr that cannot be written is the stage's to find
            while not ended.wait(REPORT_S):
                spent = time.monotonic() - started
                parts = ", ".join(filter(None, [label, f"{spent:.0f} s", left.tell()]))
                console.say(f"{parts}: {latest or 'running'}", soft_wrap=True)

    writer = Thread(target=write_lines, daemon=True)
    writer.start()
    try:
        yield tell
    finally:
        ended.set()
        writer.join()
    if not brief or time.monotonic() - started > REPORT_S:
        console.say(f"{label}: {latest or 'done'}", soft_wrap=True)
