"""Poses of motion capture that flip: of bodies whose markers are mistaken, or tags whose orientation is ambiguous.

A body jumps to another heading or place within two messages, and back. Jumps add up to offsets; the messages with
another offset than most are flipped.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from coopenv.cars.doctor.finding import Diagnosis, Finding, Treatment
from coopenv.cars.doctor.motion import SPIN
from coopenv.cars.doctor.streams import CarStreams
from coopenv.cars.messages.readings import CarPose, Sample, pose_of
from coopenv.cars.settings.profile import Role
from coopenv.estimation.poses import Array

TURNED, MOVED = 0.5, 0.2
"""rad and m, least size of a jump beyond what a car moves from one message to the next."""
FAST = 10.0
"""m/s, faster than a car drives."""
LARGE = 10.0
"""Times the larger steps between messages that no motion takes."""
FEWEST, SHARE = 6, 0.005
"""Flipped messages, and their share, from which flips are a finding; others are lost in the noise."""
AROUND = 15  # messages by which the motion without jumps is known
JUMPS = 4
"""Jumps at least: one that does not return is another frame from then on."""


def of_flips(car: CarStreams) -> Iterator[Diagnosis]:
    """Yield that motion capture flips, which leaves out the flipped messages."""
    flipped, jumps = flips(car)
    count, total = int(flipped.sum()), len(flipped)
    if jumps < JUMPS or count < max(FEWEST, SHARE * total):
        return
    text = f"motion capture of {car.name} flips to another heading or place: in {count} of {total} poses, "
    text += f"{count / total:.1%}, which are left out"
    about = Finding(car.topic([Role.TRUTH]), text, count, None, "", Treatment.LEFT_OUT, car.name)
    known = {bytes(pose) for pose in car.tracks["truth_pose"][flipped]}

    def mend(sample: Sample) -> Sample | None:
        value = sample.value
        if sample.role is not Role.TRUTH or not isinstance(value, CarPose) or value.rotation is None:
            return sample
        return None if bytes(pose_of(value)) in known else sample

    yield Diagnosis(about, lambda car: car.with_truth_of(~flips(car)[0]), mend=mend)


def flips(car: CarStreams) -> tuple[NDArray[np.bool_], int]:
    """Return which messages (n,) of motion capture are flipped, and the number of jumps."""
    time, place, yaw = (car.tracks[name] for name in ("truth_time", "truth", "truth_yaw"))
    if len(time) < FEWEST or "truth_pose" not in car.tracks:
        return np.zeros(len(time), bool), 0
    period = np.maximum(np.diff(time), 1e-6)
    turn, step = np.angle(np.exp(1j * np.diff(yaw))), np.diff(place)
    usual = LARGE * float(np.quantile(np.abs(step), 0.9))  # in whatever unit
    far = (np.abs(turn) > TURNED + SPIN * period) | (np.abs(step) > np.maximum(usual, MOVED + FAST * period))
    if far.all():
        return np.zeros(len(time), bool), 0
    turned, *moved = (_jumps(change, far, period) for change in (turn, step.real, step.imag))
    shift, heading = np.cumsum(np.append(0.0, moved[0] + 1j * moved[1])), np.cumsum(np.append(0.0, turned))
    return ~(_usual(np.exp(1j * heading), TURNED) & _usual(shift, max(usual, MOVED))), int(far.sum())


def _jumps(change: Array, far: NDArray[np.bool_], period: Array) -> Array:
    """Return changes (n,) over periods (n,), s, where these are far, beyond the motion by those around."""
    near = np.flatnonzero(~far)
    rate = median_filter(change[near] / period[near], AROUND, mode="nearest")
    return np.asarray(np.where(far, change - period * np.interp(np.arange(len(far)), near, rate), 0.0))


def _usual(offset: NDArray[np.complex128], within: float) -> NDArray[np.bool_]:
    """Return which offsets (n,) are those of most messages."""
    rows = offset[:: 1 + len(offset) // 200]
    near = np.abs(rows[:, None] - rows) < within
    usual: NDArray[np.bool_] = np.abs(offset - rows[int(near.sum(axis=1).argmax())]) < within
    return usual
