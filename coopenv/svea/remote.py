"""The remote control in the deployment file: which of its channels drive, and what their pulses say."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from coopenv.svea.network import Part

MOST_CHANNELS = 18
NEUTRAL, MOVED = 1500, 100
"""Pulse of a stick at rest, and by how much one has to change to count as moved, us."""
SHORTEST, LONGEST = 800, 2200
"""Pulses that are a signal, us."""

Channel = Annotated[int, Field(ge=1, le=MOST_CHANNELS)]


class Remote(Part):
    """Channels of the remote control, as `mavros/rc/in` numbers them from 1 on; PX4's usual order."""

    steering: Channel = 1
    """Of the stick that steers."""
    throttle: Channel = 3
    """Of the stick that drives."""
    mode_switch: int = Field(default=5, ge=0, le=MOST_CHANNELS)
    """Of the switch that chooses the autopilot's mode (0: there is none)."""

    @model_validator(mode="after")
    def _each_has_its_own(self) -> Self:
        if len({self.steering, self.throttle, self.mode_switch}) < 3:
            raise ValueError("steering, throttle and mode_switch: two of them are on the same channel")
        return self

    def fault(self, pulses: tuple[int, ...]) -> str:
        """Return why pulses, us, one per channel, tell nothing; empty where they do."""
        for name in ("steering", "throttle", "mode_switch"):
            channel = getattr(self, name)
            if pulses and channel > len(pulses):
                return f"its remote control has {len(pulses)} channels, remote.{name} is {channel}"
            if not pulses or (channel and not SHORTEST <= pulses[channel - 1] <= LONGEST):
                return "its remote control has no signal"
        return ""

    def drives(self, pulses: tuple[int, ...]) -> bool:
        """Return whether a stick is moved; one without a signal is not."""
        used = [pulses[channel - 1] for channel in (self.steering, self.throttle) if channel <= len(pulses)]
        return any(SHORTEST <= pulse <= LONGEST and abs(pulse - NEUTRAL) > MOVED for pulse in used)

    def switched(self, pulses: tuple[int, ...], before: tuple[int, ...]) -> bool:
        """Return whether the switch is no longer where it was."""
        if not 0 < self.mode_switch <= min(len(pulses), len(before)):
            return False
        return abs(pulses[self.mode_switch - 1] - before[self.mode_switch - 1]) > MOVED
