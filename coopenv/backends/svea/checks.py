"""What has to be so before wheels turn."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np

from coopenv.backends.svea.bounds import misplaced
from coopenv.backends.svea.intake import VELOCITY, Intake
from coopenv.backends.svea.station import Station
from coopenv.backends.svea.status import StatusBoard
from coopenv.backends.svea.vitals import Vitals
from coopenv.svea.deployment import Deployment
from coopenv.svea.samples import Calibration
from coopenv.svea.topics import Role, topic_of

PIXELS = 2.0
"""By which a camera's own calibration may differ from the environment's."""
DISTORTION = 0.02  # likewise, each coefficient


@dataclass(frozen=True)
class Fleet:
    """What is checked."""

    deployment: Deployment
    calibrations: dict[str, Calibration]  # of the environment, by car
    station: Station
    intake: Intake
    board: StatusBoard
    vitals: Vitals
    others: Collection[str]  # cars of the fleet that are not driven here


def problems_of(fleet: Fleet) -> Iterator[str]:
    """Yield what is not as it has to be, the first that one would look at first."""
    safety, sensors = fleet.deployment.safety, fleet.deployment.sensors
    for car in fleet.calibrations:
        yield from _its_clock(fleet, car)  # by which all else is judged
        for role in VELOCITY[sensors.odometry]:
            topic = topic_of(car, role)
            if (age := fleet.station.silence(topic)) > safety.odometry_age:
                yield f"{car}: no odometry on {topic} {_since(age)}"
            if (age := fleet.vitals.age(car, role)) > safety.odometry_age:
                yield f"{car}: nothing new that could be used on {topic} {_since(age)}"
        camera = topic_of(car, Role(sensors.detections))
        if (age := fleet.station.silence(camera)) > safety.odometry_age:
            yield f"{car}: no camera frames on {camera} {_since(age)}"
        yield from _about_itself(fleet, car)
    if safety.judge == "truth":  # what cars believe is not known before they drive
        for car, wrong in misplaced(safety, fleet.vitals, fleet.calibrations, fleet.others):
            yield f"{car}: {wrong}"


def _its_clock(fleet: Fleet, car: str) -> Iterator[str]:
    safety, offset = fleet.deployment.safety, fleet.intake.offsets[car].seconds
    if offset is not None and abs(offset) > safety.max_clock_offset:
        yield (
            f"{car}: its clock is {abs(offset) * 1e3:.0f} ms {'behind' if offset > 0 else 'ahead of'} this computer's, "
            f"{safety.max_clock_offset * 1e3:.0f} ms are allowed: let chrony or PTP synchronise them"
        )


def _about_itself(fleet: Fleet, car: str) -> Iterator[str]:
    safety = fleet.deployment.safety
    if obstacle := fleet.board.obstacle(car):
        yield f"{car}: {obstacle}"
    battery = fleet.board.battery(car)
    if battery is None and fleet.deployment.conditions and safety.min_battery > 0.0:
        yield f"{car}: its battery does not tell how much is left (safety.min_battery = 0 does without)"
    if battery is not None and battery < safety.min_battery:
        yield f"{car}: its battery is at {100 * battery:.0f} %, {100 * safety.min_battery:.0f} % are needed"
    told, used = fleet.board.calibration(car), fleet.calibrations[car]
    if told is not None and (difference := _difference(told, used)):
        yield f"{car}: its camera says {difference}"


def _difference(told: Calibration, used: Calibration) -> str:
    """Return in which entry two calibrations differ, empty where they agree."""
    for name, tolerance in (("image_size", 0.5), ("focal_length", PIXELS), ("principal_point", PIXELS)):
        a, b = getattr(told, name), getattr(used, name)
        if (np.abs(np.subtract(a, b)) > tolerance).any():
            return f"{name} = {list(a)}, the environment says {list(b)}"
    if (np.abs(np.subtract(told.distortion, used.distortion)) > DISTORTION).any():
        return f"distortion = {list(told.distortion)}, the environment says {list(used.distortion)}"
    return ""


def _since(age: float) -> str:
    return "(nothing has ever come)" if np.isinf(age) else f"for {age:.2f} s"
