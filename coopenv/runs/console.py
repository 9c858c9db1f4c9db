"""Progress, notices and tables on the terminal."""

import json
import math
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from math import inf, isnan, nan
from pathlib import Path
from time import monotonic
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from coopenv.base.format import column, seconds, three_digits
from coopenv.estimation.metrics import CONVERGED, SETTLED
from coopenv.report.table import Column, Table
from coopenv.world import launch
from coopenv.world.launch import start_warp

LINE_PERIOD = 10.0  # s between lines of progress where there is no terminal
ENOUGH = 1.0  # s of work after its first part, from which on its pace can be estimated; at least 2 % are then done
HINT_FROM = 20.0  # s of work left as soon as its pace is known, from which on there is a line at once
MOST_SHOWN = 0.99  # share of a bar at most while its results are still computed or written
COMPILE_NOTICE_AFTER = 1.5  # s between looks for what is being compiled; shorter compilations are not announced


class Progress:
    """Shows how far a piece of work is: a bar that vanishes on a terminal, elsewhere a line every 10 s.

    Where there is much to do, the first line comes as soon as it can say how long that will take.

    with Progress(log, "simulating", total=300) as progress:
        progress.update(30)
    """

    def __init__(self, log: Console, description: str, total: float | None = None, rate: float | None = None) -> None:
        """Describe the work.

        Args:
            log: console of the line.
            description: name of the work.
            total: the value of `completed` at the end; None where it is not known.
            rate: amount completed in a second if known, as in real time (None: as measured).
        """
        self._drawn = log.is_terminal and log.file.isatty()  # notebooks ask for colours and are no terminal
        self._log, self._description, self._total, self._completed = log, description, total, 0.0
        self._rate, self._hinted, self._waiting = rate, False, True
        self._first: tuple[float, float] | None = None
        """Time (s) and amount of the first parts, which compiling may have slowed down."""
        self._burst = inf
        """End (s) of the time in which parts count as first ones: parallel processes finish theirs together."""
        self._over = threading.Event()
        columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
        self._bar = Bar(*columns, console=log, transient=True)
        self._task = self._bar.add_task(description, total=total)
        self._lines = threading.Thread(target=self._write_lines, daemon=True)

    def __enter__(self) -> Self:
        self._begin = monotonic()
        if self._drawn:
            self._bar.start()
        else:
            self._lines.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        if self._drawn:
            self._bar.stop()

    def update(self, completed: float, description: str | None = None) -> None:
        """Say how much is done, and what is being done now; time counts from a first word that nothing is done yet."""
        now = monotonic()
        if completed == 0.0 and self._waiting:
            self._begin = now
        self._waiting = False
        if completed > 0.0 and now < self._burst:
            self._burst = min(self._burst, now + 0.25 * (now - self._begin))
            self._first = now, completed
        self._completed, self._description = completed, description or self._description
        drawn = min(completed, MOST_SHOWN * (self._total or inf))
        self._bar.update(self._task, completed=drawn, total=self._total, description=self._description)
        if not self._hinted and not isnan(left := self._left()):
            self._hinted = True
            if left > HINT_FROM and not self._drawn:
                self._log.print(self.line(), soft_wrap=True)

    def advance(self, description: str | None = None) -> None:
        """Say that one more unit is done."""
        self.update(self._completed + 1.0, description)

    def line(self) -> str:
        """Return the progress of the work, e.g. `simulating: 40 % after 20 s, about 30 s left`."""
        elapsed, left, share = monotonic() - self._begin, self._left(), self._share
        done = f"{100 * min(share, MOST_SHOWN):.0f} % after " if share else ""
        rest = ", results follow" if share >= 1.0 else "" if isnan(left) else f", about {left:.0f} s left"
        return f"{self._description}: {done}{elapsed:.0f} s{rest}"

    @property
    def _share(self) -> float:
        return self._completed / self._total if self._total else 0.0

    def _left(self) -> float:
        """Return the time that the rest will take at the pace since the first part, s; NaN: not known yet."""
        if self._first is None or not self._share < 1.0:
            return nan
        left = (self._total or nan) - self._completed
        if self._rate is not None:
            return left / self._rate
        (begin, first), now = self._first, monotonic()
        if now - begin < ENOUGH or self._share < 0.02 or self._completed <= first:
            return nan
        return left * (now - begin) / (self._completed - first)

    def _write_lines(self) -> None:
        while not self._over.wait(LINE_PERIOD):
            self._log.print(self.line(), soft_wrap=True)


def note_overwritten(folder: Path | None, names: Sequence[str], log: Console) -> None:
    """Print what a run will overwrite in a folder, if anything; `names` are those of its files, its facts first."""
    found = [folder / name for name in names if (folder / name).is_file()] if folder is not None else []
    if found:
        what = "an earlier result"
        with suppress(OSError, ValueError, TypeError, KeyError):  # not of a run
            what = f"seed {json.loads(found[0].read_bytes())['seed']:d}"
        log.print(f"overwrites {what} in {folder}", soft_wrap=True)


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
    """Return the number of functions that Numba has compiled in this process; Numba is not loaded for this."""
    return len(getattr(sys.modules.get("coopenv.estimation.compiled"), "fresh", ()))


VEHICLE = Column("vehicle", "\nvehicle", number=False)
COLUMNS = (
    VEHICLE,
    Column("initial_position_error_m", "start", "m", column),
    Column("initial_orientation_error_deg", "", "deg", column),
    Column("settle_time_s", "settles", "s", seconds),
    Column("convergence_time_s", "converges", "s", seconds),
    Column("steady_position_rmse_m", "RMSE", "m", column),
    Column("steady_orientation_rmse_deg", "", "deg", column),
    Column("mean_targets_in_view", "targets\nseen", write=column),
    Column("mean_nees", "mean\nNEES", write=column),
)
"""Of metrics of vehicles: errors at the start, times, errors in the steady state, targets, NEES."""

ESTIMATES = (
    VEHICLE,
    Column("x", "ends at x", "m", column),
    Column("y", "y", "m", column),
    Column("final_yaw_estimate_deg", "yaw", "deg", column),
    Column("position_std_m", "std", "m", column),
    Column("orientation_std_deg", "", "deg", column),
    Column("mean_targets_in_view", "targets\nseen", write=column),
)
"""Of vehicles without true poses: last estimate, standard deviations, targets."""

RATES = (
    Column("vehicle", "rate\nvehicle", number=False),
    Column("rate_per_s", "fitted", "1/s", three_digits),
    Column("slowest_rate_per_s", "slowest 5 s", "1/s", three_digits),
    Column("slowest_rate_from_s", "from", "s", three_digits),
    Column("guaranteed_rate_per_s", "guaranteed", "1/s", three_digits),
    Column("guaranteed_rate_at_s", "at", "s", three_digits),
    Column("frozen_rate_window_per_s", "frozen, 5 s", "1/s", three_digits),
    Column("frozen_rate_window_from_s", "from", "s", three_digits),
)
"""Of metrics of vehicles: measured rates beside those of the theory."""

VERDICTS = {
    "not_observable_s": "not observable",
    "carried_by_odometry_s": f"not observable now, but carried by odometry (within {CONVERGED.text})",
}


def estimates_table(vehicles: list[dict[str, Any]]) -> Table:
    """Return the table of vehicles without true poses."""
    ends = (vehicle["final_position_estimate_m"] for vehicle in vehicles)
    rows = [{**vehicle, "x": x, "y": y} for vehicle, (x, y, *_) in zip(vehicles, ends, strict=True)]
    return Table.of(ESTIMATES, rows, folds=True)


def rates(vehicles: list[dict[str, Any]]) -> Iterator[Table | str]:
    """Yield the measured rates beside the theory's, and their meaning; nothing without a theory."""
    if all(math.isnan(vehicle["guaranteed_rate_per_s"]) for vehicle in vehicles):
        return
    yield Table.of(RATES, vehicles, folds=True)
    yield "Guaranteed: the least of the run, in the norm of P. Frozen: k lambda_min(P M)."
    yield ""


def legend(steady_from: float, end: float, nees_dof: int) -> Iterator[str]:
    """Yield the meaning of the columns, for the start of the steady state and the end of the run, s."""
    yield f"Settles: stays below {SETTLED.text}. Converges: stays below {CONVERGED.text}."
    if steady_from < end:
        yield f"RMSE and NEES: steady state, after {steady_from:g} s. NEES of a consistent estimate: {nees_dof}."
    else:
        yield f"No steady state: it would begin at {steady_from:g} s (see --steady-from)."


def gaps(metrics: Mapping[str, Any], judged: int, until: float) -> Iterator[str]:
    """Yield the gaps of a recording: truth, so that `judged` ticks up to a time, s, count, and measurements."""
    total = metrics.get("ticks", 0) + 1
    if judged < total:
        yield f"Judged at {judged} of {total} ticks, up to {until:g} s: at the others a true pose is not known."
    for vehicle, ticks in metrics.get("missing_ticks", {}).items():
        if ticks > 0.01 * total:
            yield f"{vehicle}: no odometry at {ticks} of {total} ticks; its last was kept, and no bearing was used"


def remarks(vehicles: list[dict[str, Any]]) -> Iterator[str]:
    """Yield remarks: early ends, gaps in observability, mirrored estimates."""
    for vehicle in vehicles:
        if not math.isnan(vehicle["ended_at_s"]):
            yield f"{vehicle['vehicle']}: {vehicle['outcome']} at {vehicle['ended_at_s']:.2f} s, where its figures end"
    for vehicle in vehicles:
        for key, words in VERDICTS.items():
            if gaps := vehicle["observability"][key]:
                times = ", ".join(f"{start:.4g}-{end:.4g}" for start, end in gaps)
                yield f"{vehicle['vehicle']}: {words} at {times} s"
    for vehicle in vehicles:
        if vehicle["mirrored"]:
            angle = f"{vehicle['final_orientation_error_deg']:.4g} deg"
            yield f"{vehicle['vehicle']}: mirrored solution, the orientation ends {angle} off"
