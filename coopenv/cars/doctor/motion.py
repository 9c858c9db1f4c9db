"""Checks of turn rates and velocities: against motion capture, bearings, their own poses, and commands."""

import math
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.cars.bags.clocks import SampledSignal, turn_of
from coopenv.cars.doctor.finding import Change, Diagnosis, Finding, Mend, Treatment, with_error
from coopenv.cars.doctor.relation import INTERVAL, Relation, intervals, relation
from coopenv.cars.doctor.streams import MOVING, TURNING, CarStreams
from coopenv.cars.doctor.turning import TURNED
from coopenv.cars.messages.readings import CarPose, Sample
from coopenv.cars.settings.profile import Role
from coopenv.estimation.poses import Array

FACTORS = {
    "the other sign": -1.0,
    "deg/s instead of rad/s": math.degrees(1.0),
    "deg/s instead of rad/s, with the other sign": -math.degrees(1.0),
    "converted to rad/s twice": math.radians(1.0),
    "turns per second instead of rad/s": 0.5 / math.pi,
}
"""Wrong factors of turn rates by their names."""
SPEED_FACTORS = {
    "the other sign": -1.0,
    "km/h instead of m/s": 3.6,
    "mph instead of m/s": 2.23694,
    "mm/s instead of m/s": 1000.0,
    "cm/s instead of m/s": 100.0,
    "m/s taken for km/h": 1.0 / 3.6,
    "mm/s taken for m/s": 0.001,
    "cm/s taken for m/s": 0.01,
}
"""Wrong factors of speeds."""
NAMED = 0.15
"""Relative distance of a factor from a named one: three standard deviations of a wheel's scale of 5 %."""
TRANSLATED = 0.3
"""The same by bearings, whose turns contain translation."""
TURNS = 0.05
"""rad, least standard deviation of turns over an interval at which turn rates are compared."""
MOVES = 0.05
"""m, likewise of displacements."""
FOLLOWS = 0.6
"""Share of the variance that a right stream explains at least; noise takes under 0.1 at `TURNS` and `MOVES`."""
SURE, LAGS = 0.9, (*np.arange(-1.0, 0.0, 0.1), *np.arange(0.1, 1.05, 0.1))
"""Share of the variance from which no other lag is tried, and lags, s."""
IN_THE_ROOM = "is in the frame of"
"""Words of a velocity that is not in the body's frame."""
TURNING_WHEEL, RPM = 2.0, 30.0 / math.pi
"""Factor from which speeds may be a wheel's turn rates, and rpm of 1 rad/s."""
LEAST = 0.05
"""Practical size: a scale by which 20 s of driving at 0.3 m/s are 0.3 m off without bearings."""


def bearing_turn(car: CarStreams) -> SampledSignal | None:
    """Return the heading by the median change of the azimuths of landmarks, translation included; None: too few."""
    return turn_of(*car.sightings_in_plane) if len(car.time) > 1 else None


def turning_factor(car: CarStreams, heading: SampledSignal, axis: int = 2) -> Relation | None:
    """Return the turn rates about an axis as a multiple of those of a heading; None: too few, or it hardly turns."""
    time = car.tracks["gyro_time"]
    if len(time) < 2:
        return None
    measured = SampledSignal.of_rates(time, car.turning[:, axis])
    begin, end = intervals(measured, heading)
    turned = heading.over(begin, end)[:, 0]
    if not np.isfinite(turned).any() or float(np.nanstd(turned)) < TURNS:
        return None
    return at_best(lambda lag: relation(begin, measured.over(begin + lag, end + lag)[:, 0], turned))


def named(factor: float, factors: dict[str, float], within: float = NAMED) -> tuple[str, float] | None:
    """Return the name of a factor and its exact value, from which it may differ by a share; None: it has none."""
    name, value = min(factors.items(), key=lambda entry: abs(factor / entry[1] - 1.0))
    return (name, value) if abs(factor / value - 1.0) < within else None


def of_turning(car: CarStreams, use_truth: bool) -> Iterator[Diagnosis]:
    """Yield what is wrong with sign, unit and axes of turn rates; `use_truth`: motion capture is a reference.

    Without motion capture bearings are the reference; translation then explains factors between 0.5 and 2.
    """
    topic, least = car.topic(TURNING), practical_scale(car)
    if car.truth_signals is not None and use_truth:
        reference, what = car.truth_signals[1], "motion capture"
    elif car.own_signals is not None:
        reference, what = car.own_signals[1], "its own poses"
    elif (seen := bearing_turn(car)) is not None:
        reference, what, least = seen, "bearings", 1.0
    else:
        return
    found = turning_factor(car, reference)
    if found is None:
        return
    factor = found.factor.real
    if found.explained < FOLLOWS:
        yield from _other_axis(car, reference, what, topic, found)
        return
    if not found.differs(least) or (what == "bearings" and 0.5 < factor < 2.0):
        return
    known = named(factor, FACTORS, TRANSLATED if what == "bearings" else NAMED)
    size = with_error(factor, found.error)
    text = f"the turn rate of {car.name} is {size} times that of {what}"
    exact, treatment = (factor, Treatment.REFUSED) if known is None else (known[1], Treatment.MENDED)
    key = f"corrections.{car.name}.gyro_factor = {1.0 / exact:.{4 if known is None else 6}g}"
    text += "" if known is None else f" ({known[0]})"
    about = Finding(topic, text, factor, found.error, key, treatment, car.name)
    yield Diagnosis(about, turned_by(np.eye(3) / exact))


def practical_scale(car: CarStreams) -> float:
    """Return the relative scale up to which a scale is no finding."""
    return max(LEAST, 3.0 * car.scale_noise)


def turned_by(matrix: Array) -> Change:
    """Return the change of turn rates by a matrix (3, 3)."""
    return lambda car: car.with_turning(matrix)


def turns_contradict(car: CarStreams) -> bool:
    """Return whether turns by motion capture contradict both bearings and turn rates, which agree with each other."""
    truth, seen = car.truth_signals, bearing_turn(car)
    if truth is None or seen is None:
        return False
    by_truth, by_bearings = turning_factor(car, truth[1]), turning_factor(car, seen)
    if by_truth is None or by_bearings is None or by_bearings.explained < FOLLOWS:
        return False
    agree = 0.5 < by_bearings.factor.real < 2.0
    return agree and (by_truth.explained < FOLLOWS or not 0.5 < by_truth.factor.real < 2.0)


def _other_axis(
    car: CarStreams, reference: SampledSignal, what: str, topic: str, found: Relation
) -> Iterator[Diagnosis]:
    """Yield which axis measures the turns of a car, or that no axis does."""
    for axis, name in enumerate("xy"):
        other = turning_factor(car, reference, axis)
        if other is not None and other.explained > FOLLOWS:
            size = with_error(other.factor.real, other.error)
            text = f"{car.name} turns about the {name} axis of its gyro ({size} times {what}), and not about z"
            about = Finding(topic, text, other.factor.real, other.error, "", Treatment.REFUSED, car.name)
            right = np.eye(3)[[2, 1, 0] if axis == 0 else [0, 2, 1]]
            yield Diagnosis(about, turned_by(right / other.factor.real))
            return
    if what != "bearings":
        text = f"the turn rate of {car.name} does not follow {what}: it explains {max(0.0, found.explained):.0%} of it"
        about = Finding(topic, text, found.factor.real, found.error, car=car.name, explained=False)
        yield Diagnosis(about, lambda car: car.following_truth("gyro"))


def velocity_relations(
    car: CarStreams, place: SampledSignal, heading: SampledSignal
) -> tuple[Relation | None, Relation | None]:
    """Return measured displacements as multiples of those of a path, in its body frame and in its map; None: too few.

    A turn about another point on the axis of the car moves the body to the side, too, and is fitted with it.
    """
    found = displacements(car, place, heading)
    if found is None:
        return None, None
    begin, body, driven, turn, middle = found

    def moved(lag: float) -> NDArray[np.complex128]:
        measured = SampledSignal.of_rates(car.tracks["wheel_time"], car.tracks["wheel"])
        return _planar(measured.over(begin + lag, begin + INTERVAL + lag))

    return (
        at_best(lambda lag: relation(begin, driven(lag), body, 2j * np.sin(0.5 * turn))),
        at_best(lambda lag: relation(begin, moved(lag), body * np.exp(1j * middle))),
    )


class Displacements(NamedTuple):
    """Motion over intervals by a path, and by measured velocities."""

    begin: Array  # (n,) s
    body: NDArray[np.complex128]
    """(n,) by the path, about the heading in the middle, m."""
    driven: Callable[[float], NDArray[np.complex128]]
    """Returns chords (n,) of the measured arcs with stamps that are late, s."""
    turn: Array  # (n,) rad
    middle: Array  # (n,) heading in the middle, rad


def displacements(car: CarStreams, place: SampledSignal, heading: SampledSignal) -> Displacements | None:
    """Return the motion over intervals by a path and by the wheels; None: too little."""
    time, velocity = car.tracks["wheel_time"], car.tracks["wheel"]
    if len(time) < 2:
        return None
    begin, end = intervals(SampledSignal.of_rates(time, velocity), place, heading)
    middle, turn = heading.over(begin, 0.5 * (begin + end), level=True)[:, 0], heading.over(begin, end)[:, 0]
    true = _planar(place.over(begin, end))
    known = np.isfinite(true)
    if not known.any() or float(np.sqrt(np.mean(np.abs(true[known]) ** 2))) < MOVES:
        return None

    def driven(lag: float) -> NDArray[np.complex128]:
        yaw = np.interp(time - lag, heading.times, heading.values[:, 0])
        arc = SampledSignal.of_rates(time, velocity * np.exp(1j * yaw)).over(begin + lag, end + lag)
        return np.asarray(_planar(arc) * np.exp(-1j * middle))

    return Displacements(begin, true * np.exp(-1j * middle), driven, turn, middle)


def at_best(related: Callable[[float], Relation | None]) -> Relation | None:
    """Return the relation of streams at the lag, s, at which it explains most; clocks are looked at elsewhere."""
    found = related(0.0)
    if found is None or found.explained > SURE:
        return found
    others = [other for lag in LAGS if (other := related(lag)) is not None]
    return max([found, *others], key=lambda each: each.explained)


def _planar(change: Array) -> NDArray[np.complex128]:
    return np.asarray(change[:, 0] + 1j * change[:, 1])


def of_velocity(car: CarStreams, use_truth: bool) -> Iterator[Diagnosis]:
    """Yield what is wrong with sign, unit, axes and frame of velocities; `use_truth`: motion capture is a reference."""
    topic, truth, own = car.topic(MOVING), car.truth_signals if use_truth else None, car.own_signals
    for paths, what in ((own, "its own poses"), (truth, "motion capture")):
        if paths is None:
            continue
        body, room = velocity_relations(car, *paths)
        if body is None or room is None:
            continue
        if room.explained > FOLLOWS and (1.0 - room.explained) < 0.5 * (1.0 - body.explained):
            yield _in_the_room(car, topic, what, room, paths[1], own is paths)
            return
        if body.explained < FOLLOWS:
            text = (
                f"the velocity of {car.name} does not follow {what}: it explains {max(0.0, body.explained):.0%} of it"
            )
            about = Finding(topic, text, body.explained, car=car.name, explained=False)
            yield Diagnosis(about, lambda car: car.following_truth("wheel"))
            return
        if body.differs(practical_scale(car)):
            yield _velocity(car, topic, what, body)
            return


def moved_by(factor: complex) -> Change:
    """Return the change of velocities by a factor."""
    return lambda car: car.with_tracks(wheel=factor * car.tracks["wheel"])


def _in_the_room(
    car: CarStreams, topic: str, what: str, room: Relation, heading: SampledSignal, own: bool
) -> Diagnosis:
    """Return the finding of velocities in the frame of the map."""
    angle = math.degrees(float(np.angle(room.factor)))
    turned = f", turned by {angle:.0f} deg" if abs(angle) > 3.0 else ""
    text = (
        f"the velocity of {car.name} {IN_THE_ROOM} {what}{turned}, and not in the car's: "
        f"{with_error(abs(room.factor), room.error)} times the motion there, {room.explained:.0%} explained"
    )
    treatment = Treatment.MENDED if own and not turned else Treatment.REFUSED
    key = "its own poses, which turn it" if own and not turned else ""

    def change(car: CarStreams) -> CarStreams:
        time = np.clip(car.tracks["wheel_time"], heading.times[0], heading.times[-1])
        yaw = np.interp(time, heading.times, heading.values[:, 0])
        return moved_by(np.exp(-1j * np.angle(room.factor)))(
            car.with_tracks(wheel=car.tracks["wheel"] * np.exp(-1j * yaw))
        )

    return Diagnosis(Finding(topic, text, abs(room.factor), room.error, key, treatment, car.name), change)


def _velocity(car: CarStreams, topic: str, what: str, body: Relation) -> Diagnosis:
    """Return the finding of a wrong sign, unit, scale or direction of velocities."""
    size, angle = abs(body.factor), math.degrees(float(np.angle(body.factor)))
    signed = size if abs(angle) < 90.0 else -size
    crooked = abs(math.sin(math.radians(angle))) > 0.3
    if crooked or (signed > 0.0 and abs(body.factor.imag) > abs(size - 1.0)):
        shown, treatment = with_error(angle, math.degrees(body.error / size)), Treatment.USED
        text = f"the velocity of {car.name} points {shown} deg to the left of the motion by {what}"
        if crooked:
            text, treatment = f"{text}: other axes", Treatment.REFUSED
        about = Finding(topic, text, angle, math.degrees(body.error / size), "", treatment, car.name)
        return Diagnosis(about, moved_by(np.exp(-1j * np.angle(body.factor))))
    known = named(signed, SPEED_FACTORS)
    exact = signed if known is None else known[1]
    text = f"the velocity of {car.name} is {with_error(signed, body.error)} times that of {what}"
    key = f"corrections.{car.name}.wheel_factor = {1.0 / exact:.6g}"
    treatment = Treatment.REFUSED if abs(size - 1.0) > 0.3 else Treatment.USED
    if known is not None:
        text, treatment = f"{text} ({known[0]})", Treatment.MENDED
    elif size > TURNING_WHEEL:
        text += f" (of a wheel with a radius of {1.0 / size:.2g} m in rad/s, or of {RPM / size:.2g} m in rpm?)"
    parts = (f"{car.name}: wheel scale",) if known is None else ()
    return Diagnosis(Finding(topic, text, signed, body.error, key, treatment, car.name), moved_by(1.0 / exact), parts)


FROZEN = 1.0
"""s, least duration of equal values in a row."""
SLOW = math.radians(1.0)
"""rad/s of a turn that is no more than a bias: of robots that hold a command, and whose odometry is the command."""
NOISY = 0.3
"""Share of the changes of a value that turn back at once above which it has noise; of white noise two thirds do."""
SPIN = 6.0
"""rad/s, faster than a car turns: a body of motion capture whose markers were mistaken."""
STUCK = 0.15
"""m by which a position by wheels and one by motion capture may differ over such a time, 0.15 m/s for a second."""


def of_frozen_streams(car: CarStreams) -> Iterator[Diagnosis]:
    """Yield streams that repeat a value while another one shows that the car moves."""
    known = len(car.tracks["truth_time"]) > 2 and len(car.tracks["wheel_time"]) > 1
    named = [
        each for found in (_frozen_velocity, _frozen_turning, _frozen_truth) if known for each in islice(found(car), 1)
    ]
    yield from named
    subjects = {each.finding.subject for each in named}
    yield from islice((each for each in _frozen_noise(car) if each.finding.subject not in subjects), 1)


def _frozen_noise(car: CarStreams) -> Iterator[Diagnosis]:
    """Yield streams with noise of their own that repeat a value other than 0, which needs no other stream."""
    for kind, what, roles in (("wheel", "velocity", MOVING), ("gyro", "turn rate", TURNING)):
        time, values = car.tracks[f"{kind}_time"], car.tracks[kind]
        change, runs = np.diff(values.real), [*frozen(time, values)]
        back, inside = change[1:] * change[:-1] < 0.0, np.zeros(max(0, len(time) - 2), bool)
        for begin, end, _ in runs:
            inside |= (time[2:] > begin) & (time[2:] <= end)
        if inside.all() or back[~inside].mean() < NOISY:
            continue
        for begin, end, first in runs:
            if values[first]:
                text = f"the {what} of {car.name} is {values[first].real:.4g} in a row for {end - begin:.1f} s"
                text += ", and has noise before or after"
                yield Diagnosis(Finding(car.topic(roles), text, treatment=Treatment.REFUSED, car=car.name))


def _repeated(car: CarStreams, kind: str) -> Iterator[tuple[float, float, int, NDArray[np.bool_]]]:
    """Yield begins, ends, s, first places and poses of motion capture (n,) of runs of equal wheel or gyro values."""
    truth_time = car.tracks["truth_time"]
    for begin, end, first in frozen(car.tracks[f"{kind}_time"], car.tracks[kind]):
        inside = (truth_time >= begin) & (truth_time <= end)
        if inside.sum() > 2:
            yield begin, end, first, inside


def _frozen_velocity(car: CarStreams) -> Iterator[Diagnosis]:
    for begin, end, first, inside in _repeated(car, "wheel"):
        speed, place, lasted = float(abs(car.tracks["wheel"][first])), car.tracks["truth"][inside], end - begin
        way, claimed = float(np.abs(np.diff(place[::5])).sum()), speed * lasted
        far = max(claimed, float(np.ptp(np.abs(place - place[0]))))
        if abs(way - claimed) > max(STUCK, 0.1 * way) and far > STUCK:
            text = f"the velocity of {car.name} is {speed:.3g} m/s in a row for {lasted:.1f} s, in which "
            text += f"motion capture moves it by {way:.2f} m"
            about = Finding(car.topic(MOVING), text, way - claimed, None, "", Treatment.REFUSED, car.name)
            yield Diagnosis(about, lambda car, b=begin, e=end: car.following_truth("wheel", b, e))  # type: ignore[misc]


def _frozen_turning(car: CarStreams) -> Iterator[Diagnosis]:
    for begin, end, first, inside in _repeated(car, "gyro"):
        rate = float(car.tracks["gyro"][first]) + 0.0  # no negative zero
        steps = np.diff(car.tracks["truth_time"][inside])
        turns = np.diff(np.unwrap(car.tracks["truth_yaw"][inside])) - rate * steps
        turned = float(np.ptp(np.cumsum(np.where(np.abs(turns) < SPIN * steps, turns, 0.0))))
        if turned > max(TURNED, SLOW * (end - begin)):
            text = f"the turn rate of {car.name} is {rate:.3g} rad/s in a row for {end - begin:.1f} s, in which "
            text += f"motion capture turns it by {math.degrees(turned):.0f} deg"
            about = Finding(car.topic(TURNING), text, turned, None, "", Treatment.REFUSED, car.name)
            yield Diagnosis(about, lambda car, b=begin, e=end: car.following_truth("gyro", b, e))  # type: ignore[misc]


def _frozen_truth(car: CarStreams) -> Iterator[Diagnosis]:
    wheel_time, wheel = car.tracks["wheel_time"], car.tracks["wheel"]
    for begin, end, _ in frozen(car.tracks["truth_time"], car.tracks["truth"] + 1e3 * car.tracks["truth_yaw"]):
        moving = (wheel_time >= begin) & (wheel_time <= end)
        way = float(np.abs(wheel[moving].mean()) * (end - begin)) if moving.any() else 0.0  # without noise
        if way > 2.0 * STUCK:
            text = f"motion capture repeats one pose of {car.name} for {end - begin:.1f} s, in which "
            text += f"its wheels move it by {way:.2f} m"
            about = Finding(car.topic([Role.TRUTH]), text, way, None, "", Treatment.LEFT_OUT, car.name)
            yield Diagnosis(about, _without_repeated_poses, mend=_unlike_the_last())


def _without_repeated_poses(car: CarStreams) -> CarStreams:
    """Return a car without poses of motion capture that equal those before them."""
    return car.with_truth_of(np.append(True, np.diff(car.tracks["truth"]) != 0.0))


def _unlike_the_last() -> Mend:
    """Return a mend that leaves out messages of motion capture with the place of the one before."""
    last = [np.full(3, np.nan)]

    def mend(sample: Sample) -> Sample | None:
        if sample.role is not Role.TRUTH or not isinstance(sample.value, CarPose):
            return sample
        same, last[0] = np.array_equal(sample.value.position, last[0]), sample.value.position
        return None if same else sample

    return mend


def frozen(time: Array, values: NDArray[Any]) -> Iterator[tuple[float, float, int]]:
    """Yield begin, end, s, and first place of the runs of equal values (n,) that last longer than `FROZEN`."""
    ends = np.flatnonzero(np.append(np.diff(values) != 0.0, True)) if len(values) else np.zeros(0, np.int64)
    for first, last in zip(np.append(0, ends[:-1] + 1).tolist(), ends.tolist(), strict=False):
        if time[last] - time[first] > FROZEN:
            yield float(time[first]), float(time[last]), first


FEWEST, GRID, NOISIER = 100, 0.1, 3.0
"""Different values at least, and their share, below which they are counts of an encoder, whose errors do not add up;
times its declared deviation from which on noise is a finding: information counts tenfold."""
BEND = 1.4826 / math.sqrt(6.0)
"""Deviation of white noise over the median size of its second differences."""


def of_noise(car: CarStreams) -> Iterator[Finding]:
    """Yield streams with far more noise than declared, by their second differences, in which motion hardly counts."""
    for kind, what, roles, key in (
        ("wheel", "velocity", MOVING, "noise.velocity"),
        ("gyro", "turn rate", TURNING, "noise.angular_velocity"),
    ):
        time, values = car.tracks[f"{kind}_time"], car.tracks[kind].real
        if not car.noise[kind] or len(np.unique(values)) < max(FEWEST, GRID * len(time)):
            continue
        period = float(np.median(np.diff(time)))
        std = BEND * float(np.median(np.abs(np.diff(values, 2)))) * math.sqrt(period * car.odometry_rate)
        ratio = std / car.noise[kind]
        if ratio > NOISIER:
            size = with_error(ratio, ratio / math.sqrt(len(time)))
            text = f"the noise of the {what} of {car.name} is {size} times the declared one"
            mended = f'overrides."{key}" = {std:.3g}'
            yield Finding(car.topic(roles), text, ratio, ratio / math.sqrt(len(time)), mended, car=car.name)
