"""The gate on a car's own computer: the only process that commands the wheels.

These are its decisions, without threads, clocks or a network of its own; process.py connects it to the network. It
starts quickly and needs neither NumPy nor the simulation.

It starts disarmed. An arming by the station names a session and the nonce that the gate has shown last; the nonce is a
new one after every start, arming, disarming and stop, so that an arming counts once, and only if its sender knew of
the latest stop. A disarming needs no nonce. Armed, the gate lets commands of that session through, each newer than all
before it, not older than 0.15 s, finite, and inside the limits. Until the first one the car stands.

Without another one for 0.2 s the car gets neutral: the gate has timed out. Newer commands of the same session may go on
from there: what a stalled link delivers late is older than 0.15 s and moves nothing, and what has just been sent is
what the station wants now. The car then starts from a stand, at the limited acceleration.

A stop stays until the next arming. It needs no signature: its worst result
is a car that stands. Its `false` does nothing.
"""

import math
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from coopenv.cars.gate.wheel_command import NEUTRAL, MotionCommand, write_drive
from coopenv.cars.link.keys import Verifier, is_identity
from coopenv.cars.messages.cdr import LIST, STAMP, TEXT, Malformed, read, write
from coopenv.cars.settings.limits import Limits
from coopenv.cars.settings.profile import SVEA, CarProfile, Role

COMMAND = (STAMP, TEXT, *"fffff")
"""AckermannDriveStamped: steering rad, its rate rad/s, speed m/s, acceleration m/s^2, jerk m/s^3."""
ARM = (STAMP, TEXT, TEXT, TEXT, "?")
"""Arm: session, nonce, whether to arm or to disarm."""
BOOL = ("?",)
STATUS = (STAMP, *[TEXT] * 4, *"QQ", TEXT + LIST, "Q" + LIST)
"""GateStatus: frame, session, nonce, state, accepted commands, last sequence number, reasons of refusals and counts."""


class GateMode(StrEnum):
    """Mode of the gate."""

    DISARMED = "disarmed"
    ARMED = "armed"
    TIMED_OUT = "timed_out"
    STOPPED = "stopped"


class Reason(StrEnum):
    """Why a message has been rejected; the last one stops the car: a command to the wheels that is not the gate's."""

    TOO_LONG = "too_long"
    MALFORMED = "malformed"
    NOT_ARMED = "not_armed"
    SESSION = "session"
    SEQUENCE = "sequence"
    STALE = "stale"
    FUTURE = "future"
    SIGNATURE = "signature"
    NOT_FINITE = "not_finite"
    LIMITS = "limits"
    NONCE = "nonce"
    FOREIGN = "foreign"


class Rejected(Exception):  # noqa: N818
    """A message is not accepted; its argument is the reason."""


@dataclass(frozen=True)
class GateClock:
    """Clocks of the gate."""

    wall: Callable[[], int] = time.time_ns  # ns, that of stamps
    steady: Callable[[], int] = time.monotonic_ns  # ns, never set


PERIOD = 50_000_000  # ns between outputs
TIMEOUT = 200_000_000  # ns without a valid command after which the car gets neutral
MOST_AHEAD = 50_000_000  # ns that a stamp may be ahead of the receiver's clock, here and at the station
MOST_BYTES = 512  # of a message to the gate; its own have less than 300
MOST_DIGITS = 18  # of a sequence number


@dataclass(eq=False, repr=False)
class Gate:
    """The gate of one car; calls from several threads are to be kept apart."""

    car: str  # its name, as in its topics
    limits: Limits
    clock: GateClock
    verifier: Verifier | None = None  # of the station's public key; None: nothing is signed, any station can drive it
    station: str = "station"  # identity that may arm and command
    profile: CarProfile = SVEA

    def __post_init__(self) -> None:
        """Start disarmed."""
        self._readers = {Role.COMMAND: self._command, Role.ARM: self._arm, Role.STOP: self._stop}
        self._counts = dict.fromkeys(Reason, 0)
        self._state = GateMode.DISARMED
        self.nonce = secrets.token_hex(8)
        """Nonce that the next arming must contain."""
        self._session, self._sequence, self._accepted = "", -1, 0
        self._wanted: MotionCommand | None = None  # by the last valid command, while it counts
        self._offset = 0
        """Wall clock less the steady one at the last arming, ns: a clock that is set later makes no command fresh."""
        self.commanded = self._ticked = self.clock.steady()
        """Time of the last valid command, steady clock, ns."""
        self._output = NEUTRAL
        self._braked = 0  # until when, steady clock, ns

    @property
    def braking(self) -> bool:
        """True while the gate brakes the car."""
        return self.clock.steady() < self._braked and self._wanted is None

    @property
    def _still(self) -> MotionCommand:
        return MotionCommand(brake=True) if self.braking else NEUTRAL

    @property
    def state(self) -> GateMode:
        """The state at this instant."""
        if self._wanted is not None and self.clock.steady() - self.commanded > TIMEOUT:
            self._come_to_a_stand(GateMode.TIMED_OUT)
        return self._state

    def arrive(self, role: Role, payload: bytes, attachment: bytes = b"") -> Reason | None:
        """Take a message under COMMAND, ARM or STOP, whatever its bytes are; return why it was rejected, if it was."""
        try:
            if len(payload) > MOST_BYTES:
                raise Rejected(Reason.TOO_LONG)
            self._readers[role](payload, attachment)
        except Malformed:
            reason = Reason.MALFORMED
        except Rejected as rejected:
            [reason] = rejected.args
        else:
            return None
        self._counts[reason] += 1
        return reason

    def tick(self) -> bytes:
        """Return the message for the car now; to be called every 50 ms."""
        now = self.clock.steady()
        if self.state is GateMode.ARMED and self._wanted is not None:
            # After a late call it is as if it had been in time: no jump.
            dt = min(now - self._ticked, PERIOD) / 1e9
            before, wanted = self._output, self._wanted
            speed, steering = self.limits.approach((before.speed, before.steering), (wanted.speed, wanted.steering), dt)
            self._output = MotionCommand(steering, speed)
        else:
            self._output = self._still
        self._ticked = now
        return write_drive(self.clock.wall(), self.profile.command, self._output)

    def foreign(self) -> None:
        """Stop, whatever the state: the wheels got a command that this gate has not sent."""
        self._counts[Reason.FOREIGN] += 1
        self._come_to_a_stand(GateMode.STOPPED)  # with another nonce: an arming under way opens nothing

    def neutral(self) -> bytes:
        """Close for good and return the message for a car that brakes or stands."""
        self._come_to_a_stand(GateMode.STOPPED)
        return write_drive(self.clock.wall(), self.profile.command, self._still)

    def status(self) -> bytes:
        """Return the GateStatus now."""
        state = self.state
        session = self._session if state in (GateMode.ARMED, GateMode.TIMED_OUT) else ""
        about, counted = (self.clock.wall(), "", session, self.nonce, state), (self._accepted, max(self._sequence, 0))
        return write(STATUS, *about, *counted, [*self._counts], [*self._counts.values()])

    def _command(self, payload: bytes, attachment: bytes) -> None:
        stamp, frame, *numbers = read(payload, COMMAND)
        if self.state not in (GateMode.ARMED, GateMode.TIMED_OUT):
            raise Rejected(Reason.NOT_ARMED)
        session, _, digits = frame.rpartition(":")
        if session != self._session:
            raise Rejected(Reason.SESSION)
        if not (digits.isascii() and digits.isdigit() and len(digits) <= MOST_DIGITS):
            raise Rejected(Reason.MALFORMED)
        if int(digits) <= self._sequence:
            raise Rejected(Reason.SEQUENCE)
        ages = self.clock.wall() - stamp, self.clock.steady() + self._offset - stamp
        self._check(Role.COMMAND, ages, payload, attachment)
        if not all(map(math.isfinite, numbers)):
            self._come_to_a_stand(GateMode.TIMED_OUT)  # the station itself has lost its way
            raise Rejected(Reason.NOT_FINITE)
        steering, _, speed, _, _ = numbers
        if not self.limits.permit(speed, steering):
            raise Rejected(Reason.LIMITS)
        self._sequence, self._accepted = int(digits), self._accepted + 1
        self._wanted, self.commanded = MotionCommand(steering, speed), self.clock.steady()
        self._state = GateMode.ARMED

    def _arm(self, payload: bytes, attachment: bytes) -> None:
        stamp, _, session, nonce, armed = read(payload, ARM)
        self._check(Role.ARM, (self.clock.wall() - stamp,), payload, attachment)
        if not armed:
            if self.state is not GateMode.STOPPED:
                self._come_to_a_stand(GateMode.DISARMED)
            return
        if nonce != self.nonce:
            raise Rejected(Reason.NONCE)
        if not is_identity(session):
            raise Rejected(Reason.SESSION)
        if session != self._session:  # one that is armed again goes on counting: nothing of it comes twice
            self._session, self._sequence = session, -1
        self._offset = self.clock.wall() - self.clock.steady()
        self._come_to_a_stand(GateMode.ARMED)

    def _stop(self, payload: bytes, _attachment: bytes) -> None:
        if read(payload, BOOL)[0] and self._state is not GateMode.STOPPED:
            self._come_to_a_stand(GateMode.STOPPED)

    def _come_to_a_stand(self, state: GateMode) -> None:
        """Brake, where the make can, and go on in a state with neutral output.

        Unless it is a mere time-out, earlier armings are worth nothing.
        """
        if (brake := self.profile.command.brake) and self._output.speed:
            self._braked = self.clock.steady() + round(1e9 * abs(self._output.speed) / brake.deceleration)
        self._state, self._wanted, self._output = state, None, NEUTRAL
        if state is not GateMode.TIMED_OUT:
            self.nonce = secrets.token_hex(8)

    def _check(self, role: Role, ages: tuple[int, ...], payload: bytes, attachment: bytes) -> None:
        """Reject a message that is not of this moment, by its ages in ns, or not of the station."""
        if max(ages) > self.profile.topics[Role.COMMAND].max_age_ns:
            raise Rejected(Reason.STALE)
        if min(ages) < -MOST_AHEAD:
            raise Rejected(Reason.FUTURE)
        if self.verifier is None:
            return
        if self.verifier.signer(self.profile.topic_of(self.car, role), payload, attachment) != self.station:
            raise Rejected(Reason.SIGNATURE)
