"""A finding: one stream that the others contradict, by how much, the key that mends it, and the treatment."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from math import ceil, floor, inf, log10
from typing import NamedTuple

from coopenv.cars.doctor.streams import CarStreams
from coopenv.cars.messages.readings import Sample


class Treatment(Enum):
    """Treatment of a stream that others contradict."""

    USED = "used unchanged"
    MENDED = "mended"
    LEFT_OUT = "left out"
    REFUSED = "refused"
    TRUSTED = "trusted"


@dataclass(frozen=True)
class Finding:
    """A contradiction between streams. Texts are of one line."""

    subject: str
    """The stream that is wrong: a topic, a clock, the map of landmarks or markers."""
    text: str
    """The contradiction, its size included."""
    size: float | None = None
    """The number that is wrong, in the unit of the text."""
    error: float | None = None
    """Its standard error."""
    key: str = ""
    """Key of the topic map or the environment that mends it, with its value."""
    treatment: Treatment = Treatment.USED
    car: str = ""
    explained: bool = True
    """Whether one cause explains it."""

    def __str__(self) -> str:
        """Return the finding as a line."""
        subject = f"topic {self.subject}" if self.subject.startswith("/") else self.subject
        mended = self.treatment is Treatment.MENDED
        key = f"; {'mended, as with' if mended else 'mended by'} {self.key}" if self.key else ""
        return f"{subject}: {self.text}{key}{'; trusted' if self.treatment is Treatment.TRUSTED else ''}"


Change = Callable[[CarStreams], CarStreams]
"""Returns the streams of a car without a fault."""


Mend = Callable[[Sample], Sample | None]
"""Returns a sample of a car without a fault; None: it is left out."""


class Diagnosis(NamedTuple):
    """A finding, and the change with which the examination looks for what it hides, whatever its treatment."""

    finding: Finding
    change: Change | None = None
    """None: nothing is known that removes it."""
    parts: tuple[str, ...] = ()
    """Constants that the change has estimated, by the titles of a calibration."""
    mend: Mend | None = None
    """None: that of the finding's key."""


def with_error(value: float, error: float) -> str:
    """Return a value with its standard error in brackets, in units of the last digit: 57.31(4)."""
    if not 0.0 < error < inf:
        return f"{value:.4g}"
    digits = max(0, -floor(log10(error)))
    digits = max(0, digits - (ceil(error * 10**digits) > 9))
    return f"{value:.{digits}f}({ceil(round(error * 10**digits, 6))})" if digits < 9 else f"{value:.4g}"
