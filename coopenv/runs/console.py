"""What a command says while it works: how far it is, and what takes so long."""

import sys
import threading
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager
from math import isnan, nan
from time import monotonic
from typing import Self, TypeVar

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from coopenv.world import launch
from coopenv.world.launch import start_warp

T = TypeVar("T")

LINE_PERIOD = 10.0  # s between lines of progress where there is no terminal
ENOUGH = 1.0  # s of work from which on its pace can be told
HINT_FROM = 20.0  # s of work left as soon as its pace is known, from which on there is a line at once
COMPILE_NOTICE_AFTER = 1.5  # s between looks for what is being compiled; less need not be told


class Progress:
    """Shows how far a piece of work is: a bar that vanishes on a terminal, elsewhere a line every 10 s.

    Where there is much to do, the first line comes as soon as it can say how long that will take.

    with Progress(log, "simulating", total=300) as progress:
        progress.update(30)
    """

    def __init__(self, log: Console, description: str, total: float | None = None, rate: float | None = None) -> None:
        """Describe the work.

        Args:
            log: where it is told.
            description: what is done.
            total: the value of `completed` at the end; None where it is not known.
            rate: how much is completed in a second where that is known, as in real time (None: as it turns out).
        """
        self._log, self._description, self._total, self._completed = log, description, total, 0.0
        self._rate, self._hinted = rate, False
        self._over = threading.Event()
        columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
        self._bar = Bar(*columns, console=log, transient=True)
        self._task = self._bar.add_task(description, total=total)
        self._lines = threading.Thread(target=self._write_lines, daemon=True)

    def __enter__(self) -> Self:
        self._begin = monotonic()
        if self._log.is_terminal:
            self._bar.start()
        else:
            self._lines.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        if self._log.is_terminal:
            self._bar.stop()

    def update(self, completed: float, description: str | None = None) -> None:
        """Say how much is done, and what is being done now; time counts from a first word that nothing is done yet."""
        if completed == 0.0 and self._completed == 0.0:
            self._begin = monotonic()
        self._completed, self._description = completed, description or self._description
        self._bar.update(self._task, completed=completed, total=self._total, description=self._description)
        if not self._hinted and not isnan(left := self._left()):
            self._hinted = True
            if left > HINT_FROM and not self._log.is_terminal:
                self._log.print(self.line(), soft_wrap=True)

    def advance(self, description: str | None = None) -> None:
        """Say that one more unit is done."""
        self.update(self._completed + 1.0, description)

    def track(self, items: Iterable[T]) -> Iterator[T]:
        """Yield the items, each of which is one unit of work."""
        if isinstance(items, Sized):
            self._total = len(items)
        for item in items:
            yield item
            self.advance()

    def line(self) -> str:
        """Return how far the work is, e.g. `simulating: 40 % after 20 s, about 30 s left`."""
        elapsed, left = monotonic() - self._begin, self._left()
        share = self._completed / self._total if self._total else 0.0
        if share == 0.0:
            return f"{self._description}: {elapsed:.0f} s"
        if isnan(left):
            return f"{self._description}: {100 * share:.0f} % after {elapsed:.0f} s"
        return f"{self._description}: {100 * share:.0f} % after {elapsed:.0f} s, about {left:.0f} s left"

    def _left(self) -> float:
        """Return the time that the rest will take at the pace so far, s; NaN where that is not known yet."""
        share = self._completed / self._total if self._total else 0.0
        elapsed = monotonic() - self._begin
        if not 0.0 < share <= 1.0:
            return nan
        if self._rate is not None:
            return ((self._total or nan) - self._completed) / self._rate
        return elapsed * (1.0 - share) / share if elapsed >= ENOUGH else nan

    def _write_lines(self) -> None:
        while not self._over.wait(LINE_PERIOD):
            self._log.print(self.line(), soft_wrap=True)


@contextmanager
def compile_notice(log: Console) -> Iterator[None]:
    """Say what takes so long where Warp compiles kernels, or Numba functions, that are not in its cache."""
    start_warp()
    before, functions, over = launch.modules(), _compiled_functions(), threading.Event()

    def watch() -> None:
        while not over.wait(COMPILE_NOTICE_AFTER):
            if launch.modules() - before or _compiled_functions() > functions:
                log.print("compiling kernels (once per machine) ...")
                return

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        over.set()


def _compiled_functions() -> int:
    """Return how many functions Numba has compiled in this process; where nothing needs it, it is not loaded."""
    return len(getattr(sys.modules.get("coopenv.estimation.compiled"), "fresh", ()))
