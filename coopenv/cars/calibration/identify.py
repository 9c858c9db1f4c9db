"""A fake car that is a real one: actuation, noise and links by a drive, and how far the fake is from the drive."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import ks_2samp

from coopenv.base.errors import DataError, check_one_of
from coopenv.cars.bags.bag import Bag
from coopenv.cars.calibration.batch import deviation, stated_rate
from coopenv.cars.calibration.calibrate import ConstantRow, tables_text
from coopenv.cars.calibration.response import DEAD_BAND, KINDS, Response, constants_of
from coopenv.cars.fake.car import Sent, replay
from coopenv.cars.fake.settings import USUAL, FakeSettings
from coopenv.cars.gate.wheel_command import MotionCommand
from coopenv.cars.messages.readings import CarPose, Detections, Sample, tracks_of
from coopenv.cars.settings.profile import Role
from coopenv.estimation.poses import Array
from coopenv.scenario import load_scenario

PARTS = 10  # of a drive, by whose spread measured levels have standard errors
STEP = 0.2  # s over which changes are compared
COMPARED = 60.0  # s of the drive that a fake repeats
SENSORS = (Role.WHEEL, Role.IMU, Role.DETECTIONS, Role.BEARINGS)
CUT = 3.0  # times the 90 % quantile, beyond which a sighting is another block's
MOST = 0.49  # share of a fake's loss and jitter
LATEST = 1.0  # s, delay beyond which clocks differ


@dataclass(frozen=True)
class Distance:
    """Kolmogorov-Smirnov distances, 0 to 1, of a quantity."""

    quantity: str
    samples: int  # in the bag
    given: float  # between the bag and a fake as the environment has it
    identified: float  # and the identified one
    seeds: float  # between two identified ones with other seeds: by chance


@dataclass(frozen=True)
class Identified:
    """The result."""

    car: str
    rows: tuple[ConstantRow, ...]
    distances: tuple[Distance, ...]


def identify(bag: Bag, car: str | None = None) -> Identified:
    """Return the fake that a car of a bag is; None: the first with commands. Raises DataError: too few commands."""
    sent = {
        name: {role: found for (of, role), found in bag.log.sent.items() if of == name} for name in bag.binding.cars
    }
    if car is None:
        car = next((name for name in sent if Role.MANUAL in sent[name] or Role.COMMAND in sent[name]), next(iter(sent)))
    check_one_of("unknown car", car, sent, DataError)
    samples = [s for s in bag.log.samples if s.car == car]
    vehicle, profile = bag.binding.cars[car], bag.binding.profile
    limits = bag.scenario.limits[vehicle]
    response = Response(
        tracks_of(samples, bag.log.samples[0].stamp), limits.wheelbase, profile.command.timeout, f"{bag.where}: {car}"
    )
    given = np.array([_given(limits, kind.name) for kind in KINDS])
    found = constants_of(response, given, limits.dead_band)
    rows = []
    for kind, old, value, error, beyond in zip(KINDS, given, found.x, found.error, found.beyond, strict=True):
        finding = BEYOND if beyond else "" if 0.0 < error < kind.prior / np.sqrt(2.0) else UNKNOWN
        rows.append(ConstantRow(kind.name, kind.unit, old, old if finding == UNKNOWN else value, error, finding))
    low, high = found.dead
    rows.append(ConstantRow(DEAD_BAND, "m/s", limits.dead_band, (low + high) / 2, (high - low) / np.sqrt(12.0), ""))
    rows += [*_noise(bag, vehicle, response, found.rest), *_links(sent[car], bag, vehicle)]
    drives = [s for s in samples if isinstance(s.value, MotionCommand)]
    return Identified(car, tuple(rows), tuple(_distances(bag, car, rows, sent[car], drives)))


BEYOND = "not reached: at least this"
UNKNOWN = "not determined by this drive"


def _given(limits: Any, name: str) -> float:
    table, name = name.split(".")
    if table == "dynamics":
        return float(getattr(limits, name))
    by_the_environment = {"latency": limits.latency, "deceleration": limits.max_acceleration}
    return float(by_the_environment.get(name, getattr(USUAL, name) or 0.0))


def _level(name: str, unit: str, given: float, measure: Callable[[Array], float], values: Array) -> ConstantRow:
    """Return the estimate of values, with the standard error by parts of the drive."""
    parts = [measure(part) for part in np.array_split(values, PARTS)]
    return ConstantRow(name, unit, given, measure(values), float(np.std(parts, ddof=1)) / np.sqrt(PARTS), "")


def _noise(bag: Bag, vehicle: int, response: Response, rest: Sequence[Array]) -> Iterator[ConstantRow]:
    """Yield the noise of wheels and gyro, as the environment states it."""
    noise, rate = bag.scenario.noises[vehicle], stated_rate(bag.scenario, vehicle)
    for name, (time, _), left in zip(("velocity", "angular_velocity"), response.series, rest, strict=False):
        unit = "m/s" if name == "velocity" else "rad/s"
        scale = np.sqrt(0.5 * rate * float(np.median(np.diff(time))))
        yield _level(f"noise.{name}", unit, getattr(noise, name), deviation, scale * np.diff(left)[:, None])


def _links(sent: Sent, bag: Bag, vehicle: int) -> Iterator[ConstantRow]:
    """Yield rates, jitter, loss and delay of the sensors' messages, and noise and misses of the camera."""
    camera, steps, delays = bag.scenario.cameras[vehicle], [], []
    for role in SENSORS:
        stamp, received = _times(sent.get(role, ()))
        if len(stamp) > PARTS:
            steps.append(np.diff(stamp) / np.median(np.diff(stamp)))
            delays.append(received - stamp)
            if role in (Role.WHEEL, Role.IMU):
                name, near = f"fake.{role}_rate", np.diff(stamp)[steps[-1] < 1.5]
                yield _level(name, "Hz", getattr(USUAL, f"{role}_rate"), lambda part: 1.0 / float(part.mean()), near)
    step, delay = np.concatenate(steps), np.concatenate(delays)
    count, near = np.maximum(np.rint(step), 1.0), step[step < 1.5]
    yield _level("fake.loss", "", USUAL.loss, lambda part: min(1.0 - len(part) / float(part.sum()), MOST), count)
    yield _level("fake.jitter", "", USUAL.jitter, lambda part: min(np.sqrt(1.5) * float(part.std()), MOST), near)
    late = _level("fake.delay", "s", USUAL.delay, lambda part: _exponential(part)[0], delay)
    yield late if 0.0 <= late.value < LATEST else replace(late, value=0.0, finding="another clock")
    yield _level("fake.delay_spread", "s", USUAL.delay_spread, lambda part: _exponential(part)[1], delay)
    bend, missed = _sightings(sent)
    if len(bend) > PARTS:
        rounding = float(camera.quantise) / 12.0 / camera.focal_length[0] ** 2
        scale = bag.scenario.noises[vehicle].bearing.scale
        measure = lambda part: float(np.sqrt(max((part**2).mean() / 6.0 - rounding, 0.0)))  # noqa: E731
        near = bend[np.abs(bend) < CUT * np.quantile(np.abs(bend), 0.9)]
        yield _level("noise.bearing.scale", "rad", scale, measure, near)
        yield _level("camera.miss_probability", "", camera.miss_probability, lambda part: float(part.mean()), missed)


def _exponential(delay: Array) -> tuple[float, float]:
    """Return the least value and the mean excess of an exponential distribution, by two quantiles."""
    low, middle = np.quantile(delay, (0.05, 0.5))
    spread = max(middle - low, 0.0) / (np.log(2.0) + np.log(0.95))
    return float(low + np.log(0.95) * spread), float(spread)


def _times(samples: Sequence[Sample]) -> Array:
    """Return stamps and times of reception (2, n), s since the first stamp."""
    first = samples[0].stamp if samples else 0
    return np.array([(s.stamp - first, s.received - first) for s in samples], dtype=float).reshape(-1, 2).T * 1e-9


def _sightings(sent: Sent) -> tuple[Array, Array]:
    """Return second differences (n,) of azimuths over three frames, rad, and whether the middle one is missed (m,)."""
    frames = next((sent[role] for role in SENSORS[2:] if sent.get(role)), ())
    rows = [(s.value.markers, s.value.bearings) for s in frames if isinstance(s.value, Detections)]
    seen = [dict(zip(markers, np.arctan2(*rays[:, [0, 2]].T), strict=True)) for markers, rays in rows]
    step, bend, missed = np.diff(_times(frames)[0]), [], []
    for k in np.flatnonzero(step[1:] + step[:-1] < 3.0 * np.median(step)) if len(step) else ():
        first, middle, last = seen[k : k + 3]
        for marker in first.keys() & last.keys():
            missed.append(marker not in middle)
            bend += [first[marker] - 2.0 * middle[marker] + last[marker]] if marker in middle else []
    return np.array(bend), np.array(missed)


def _quantities(sent: Sent) -> Iterator[tuple[str, Array]]:
    """Yield the compared values."""
    for role, name, axis in ((Role.WHEEL, "linear", 0), (Role.IMU, "angular", 2)):
        samples = [s for s in sent.get(role, ()) if getattr(s.value, name) is not None]
        value = np.array([getattr(s.value, name)[axis] for s in samples])
        if len(value) > PARTS:
            time, what = _times(samples)[0], "speed" if axis == 0 else "turn rate"
            yield what, value
            yield f"{what}, change in {STEP:g} s", np.interp(time + STEP, time, value) - value
            yield f"{what}, noise", np.diff(value)
    for role in SENSORS:
        stamp, received = _times(sent.get(role, ()))
        if len(stamp) > PARTS:
            yield f"{role}, interval", np.diff(stamp)
            yield f"{role}, delay", received - stamp
    yield "bearing, noise", _sightings(sent)[0]


def _distances(
    bag: Bag, car: str, rows: Sequence[ConstantRow], sent: Sent, drives: Sequence[Sample]
) -> Iterator[Distance]:
    """Yield how far fakes with the same commands are from the bag."""
    end = drives[0].stamp + round(COMPARED * 1e9)
    commands = [(s.stamp, s.value) for s in drives if s.stamp < end and isinstance(s.value, MotionCommand)]
    truth = (s for s in bag.log.samples if (s.car, s.role) == (car, Role.TRUTH) and s.stamp >= drives[0].stamp)
    pose = next((s.value for s in truth if isinstance(s.value, CarPose)), None)
    shift = {role: round(bag.log.streams.added[car, role][1] * 1e9) for role in sent}
    first, last = drives[0].stamp, commands[-1][0]
    inside = {role: [s for s in sent[role] if first <= s.stamp + shift[role] < last] for role in sent}
    overrides, fake = tables(rows)
    changed = replace(bag.binding, scenario=load_scenario(bag.map.environment_path, {**bag.changes, **overrides}))
    makes = (bag.binding, USUAL, 0), (changed, FakeSettings(**fake), 0), (changed, FakeSettings(**fake), 1)
    fakes = [dict(_quantities(replay(binding, car, commands, made, seed, pose))) for binding, made, seed in makes]
    for name, value in _quantities(inside):
        given, identified, other = (made.get(name, np.zeros(0)) for made in fakes)
        if all(map(len, (value, given, identified, other))):
            pairs = (value, given), (value, identified), (identified, other)
            yield Distance(name, len(value), *(float(ks_2samp(*pair).statistic) for pair in pairs))


def tables(rows: Sequence[ConstantRow]) -> tuple[dict[str, float], dict[str, float]]:
    """Return overrides of the environment, and settings of the fake, that the drive determines."""
    known = {row.name: float(f"{row.value:.6g}") for row in rows if row.finding != UNKNOWN}
    fake = {name.split(".")[1]: value for name, value in known.items() if name.startswith("fake.")}
    return {name: v for name, v in known.items() if name.split(".")[0] in ("dynamics", "noise", "camera")}, fake


def toml_text(result: Identified) -> str:
    """Return overrides, settings of the fake, and all constants with their standard errors as TOML."""
    overrides, fake = tables(result.rows)
    first = "Written by coopenv identify. Key `identified` of a deployment file uses [overrides] and [fake]."
    return tables_text(first, {"overrides": overrides, "fake": fake}, result.rows)
