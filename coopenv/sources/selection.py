"""The part of recorded data that is used: an interval of time, some robots, and streams that others contradict."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any

from coopenv.base.errors import CoopenvError, DataError, check_one_of, shown

if TYPE_CHECKING:
    from coopenv.observers.recording import Recording


@dataclass(frozen=True)
class Selection:
    """The part of recorded data that is used.

    Robots that are left out are neither estimated nor judged, and the others neither measure nor receive them.
    """

    start: float | None = None
    """Time of tick 0 in the recorded data, s; None: their begin."""
    until: float | None = None
    """Time of the last tick in the recorded data, s; None: their end."""
    robots: tuple[str, ...] | None = None
    """Names, such as vehicle_1; None: all."""
    trust: tuple[str, ...] = ()
    """Topics of a ROS bag that are used although other streams contradict."""

    @classmethod
    def of(
        cls,
        start: float | None,
        until: float | None,
        robots: Sequence[str | int] | str | int | None,
        trust: Sequence[str] = (),
    ) -> Selection:
        """Return a checked selection.

        Args:
            start: begin, s.
            until: end, s.
            robots: names or numbers, 1 for vehicle_1; a text has commas between them.
            trust: topics of a ROS bag, or `all`.

        Raises:
            CoopenvError: times are not in order, or there are no robots.
        """
        for option, time in (("from", start), ("until", until)):
            number = isinstance(time, Real) and not isinstance(time, bool) and 0.0 <= float(time) < math.inf
            if time is not None and not number:
                raise CoopenvError(f"{option}: expected a time of at least 0 s, got {shown(time)}")
        if until is not None and until <= (start or 0.0):
            raise CoopenvError(f"until: {until:g} s are not after the start at {start or 0.0:g} s")
        given: Any = str(robots).split(",") if isinstance(robots, str | Real) else robots
        given = given if given is None or isinstance(given, Iterable) else ()
        names = None if given is None else tuple(dict.fromkeys(_robot_name(robot) for robot in given))
        if names is not None and ("" in names or not names):
            raise CoopenvError(f"robots: expected names or numbers such as 1,3, got {shown(robots)}")
        return cls(start, until, names, (trust,) if isinstance(trust, str) else tuple(trust))

    @property
    def given(self) -> dict[str, Any]:
        """Selected values by option."""
        values = {"from": self.start, "until": self.until, "robots": self.robots and ",".join(self.robots)}
        values["trust"] = ", ".join(self.trust) or None
        return {option: value for option, value in values.items() if value is not None}

    @property
    def remark(self) -> str:
        """Words for titles and tables on the streams that are trusted; empty: none is."""
        return f" (trusted: {', '.join(self.trust)})" if self.trust else ""

    def applied(self, recording: Recording, where: str) -> Recording:
        """Return the selected part of a recording, whose name is for errors.

        The start is that of a tick at which messages are sent. Initial estimates keep their errors: those at the begin
        of the recording, relative to the true pose.

        Raises:
            DataError: it has no such time or robot, or true poses at the start are not known.
        """
        if not self.given:
            return recording
        if self.trust:
            raise DataError(f"{where}: trust: is for ROS bags")
        from coopenv.sources.worlds import of_robots, stretch

        names = [setup.name for setup in recording.setups]
        for name in self.robots or ():
            check_one_of(f"{where}: robots: unknown robot", name, names, DataError)
        if self.robots is not None:
            recording = of_robots(recording, [i for i, name in enumerate(names) if name in self.robots])
        if self.start is None and self.until is None:
            return recording
        length, period = float(recording.t[-1]), recording.period
        first = math.ceil((self.start or 0.0) / recording.dt / period - 1e-6) * period
        last = recording.ticks - 1 if self.until is None else round(self.until / recording.dt)
        if last >= recording.ticks or first >= last:
            beyond = self.start is not None and (self.until is None or self.start > length)
            option, time = ("from", self.start) if beyond else ("until", self.until)
            raise DataError(f"{where}: {option}: {time:g} s; {length:g} s are recorded, in steps of {recording.dt:g} s")
        return stretch(recording, first, last, where)


WHOLE = Selection()
"""Everything that is recorded."""


def _robot_name(robot: Any) -> str:
    text = str(robot).strip()
    return f"vehicle_{text}" if text.isdigit() else text
