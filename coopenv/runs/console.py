"""What a command says while it works: how far it is, and what takes so long."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager
from time import monotonic
from typing import Self, TypeVar

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

T = TypeVar("T")

LINE_PERIOD = 10.0
"""s between lines of progress where there is no terminal."""
COMPILE_NOTICE_AFTER = 1.5
"""s; kernels in the cache load well within it, compiling takes longer."""


class Progress:
    """Shows how far a piece of work is: a bar that vanishes on a terminal, elsewhere a line every 10 s.

    with Progress(log, "simulating", total=300) as progress:
        progress.update(30)
    """

    def __init__(self, log: Console, description: str, total: float | None = None) -> None:
        """Describe the work.

        Args:
            log: where to show it.
            description: what is being done.
            total: the value of `completed` at the end; None where it is not known.
        """
        self._log, self._description, self._total = log, description, total
        self._completed = 0.0
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
        """Say how much is done, and what is being done now."""
        self._completed, self._description = completed, description or self._description
        self._bar.update(self._task, completed=completed, description=self._description)

    def advance(self, description: str | None = None) -> None:
        """Say that one more unit is done."""
        self.update(self._completed + 1.0, description)

    def track(self, items: Iterable[T]) -> Iterator[T]:
        """Yield the items, each of which is one unit of work."""
        if isinstance(items, Sized):
            self._total = len(items)
            self._bar.update(self._task, total=self._total)
        for item in items:
            yield item
            self.advance()

    def line(self) -> str:
        """Return how far the work is, e.g. `simulating: 40 % after 20 s, about 30 s left`."""
        elapsed = monotonic() - self._begin
        share = self._completed / self._total if self._total else 0.0
        if not 0.0 < share <= 1.0:
            return f"{self._description}: {elapsed:.0f} s"
        left = elapsed * (1.0 - share) / share
        return f"{self._description}: {100 * share:.0f} % after {elapsed:.0f} s, about {left:.0f} s left"

    def _write_lines(self) -> None:
        while not self._over.wait(LINE_PERIOD):
            self._log.print(self.line(), soft_wrap=True)


@contextmanager
def compile_notice(log: Console) -> Iterator[None]:
    """Say what takes so long when kernels are not found in Warp's cache."""
    timer = threading.Timer(COMPILE_NOTICE_AFTER, lambda: log.print("compiling kernels (once per machine) ..."))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
