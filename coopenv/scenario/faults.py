"""What goes wrong with a vehicle's computer, clock and radio; errors of its sensors stand in `[noise]` and `[camera]`.

Off by default. What is a chance or a standard deviation is drawn per vehicle and episode.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from coopenv.scenario.base import NonNegative, Part, Positive, Probability, Vector3

LONGEST_REPLAY = 60.0
"""s; so long a sender's messages are kept."""


class Restart(Part):
    """A vehicle whose computer starts anew: its observer loses all, and begins again knowing nothing of its pose."""

    chance: Probability = 0.0
    """That it happens to the vehicle in an episode."""
    time: NonNegative = 0.0
    """When, s; it takes place at the next decision, never in the first one."""
    time_spread: NonNegative = 0.0
    """So much later at most, drawn uniformly, s."""


class Corruption(Part):
    """Messages whose pose is altered on the way, so that they can still be read. What cannot is lost: `v2x.loss`."""

    probability: Probability = 0.0
    """Of each message, for all that receive it."""
    start: NonNegative = 0.0
    """From when on, s."""
    size: NonNegative = 10.0
    """Largest deviation of each coordinate of the position, m."""
    turn: NonNegative = 1.0
    """Largest component of the rotation vector by which the orientation is turned, rad."""


class Lie(Part):
    """A vehicle that broadcasts a pose other than its estimate."""

    kind: Literal["none", "jump", "drift", "replay", "collude"] = "none"
    """`jump`: a position off by `offset`; `drift`: one that walks away at `speed`; `replay`: its own message of `age`
    before, as if it were new; `collude`: as `jump`, and all that collude are off by the same, drawn once for them."""
    chance: Probability = 1.0
    """That the vehicle lies in an episode; drawn once for all that collude."""
    start: NonNegative = 0.0
    """From when on, s."""
    start_spread: NonNegative = 0.0
    """So much later at most, drawn uniformly (once for all that collude), s."""
    offset: Positive = 5.0
    """Of `jump` and `collude`, m."""
    speed: Positive = 0.05
    """Of `drift`, m/s."""
    age: Annotated[float, Field(gt=0.0, le=LONGEST_REPLAY)] = 1.0
    """Of `replay`, s; rounded to whole periods of the radio."""
    direction: Vector3 | None = None
    """Of what is added to the position, map axes, of any length (default: horizontal, drawn)."""
    std: Positive | None = None
    """What it claims to know its pose by, rad and m (default: its honest covariance)."""

    @model_validator(mode="after")
    def _direction_points_somewhere(self) -> Self:
        if self.direction is not None and sum(x * x for x in self.direction) < 1e-12:
            raise ValueError("direction: must not be zero")
        return self


class Faults(Part):
    """What goes wrong with a vehicle's computer, clock and messages."""

    clock_offset: NonNegative = 0.0
    """Standard deviation of what the vehicle's clock is off by, s. Messages seem older or newer by the difference of
    the sender's clock and the receiver's, to whole camera ticks, but never from the future."""
    restart: Restart = Restart()
    corruption: Corruption = Corruption()
    lie: Lie = Lie()

    @property
    def alters(self) -> bool:
        """Whether any message says something else than its sender believes."""
        return self.lie.kind != "none" or self.corruption.probability > 0.0

    @property
    def any(self) -> bool:
        """Whether anything may go wrong."""
        return self.alters or self.clock_offset > 0.0 or self.restart.chance > 0.0
