"""Leads of the stamps of topics by what they measure, and the moves of stamps that follow; see `clocks.py`."""

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace
from typing import Any

import numpy as np

from coopenv.cars.bags.clocks import (
    CAMERAS,
    FEWEST,
    PARALLAX,
    STEP,
    Lead,
    Leads,
    SampledSignal,
    lead_of_bearings,
    lead_of_motion,
    turn_of,
)
from coopenv.cars.bags.topic_map import TRUTH, Chosen
from coopenv.cars.doctor.streams import CarStreams
from coopenv.cars.settings.profile import Role


def leads_of(cars: Iterable[CarStreams]) -> dict[str, Lead]:
    """Return the lead of the stamps of the vehicles' topics by their measurements.

    The reference is motion capture, or the camera where there is none; topics without enough motion are left out.
    """
    found: dict[str, Lead] = {}
    for car in cars:
        moved = {role: _cumulated(car, role) for role in ODOMETRY if role in car.topics}
        truth, seen = _path(car.tracks), car.sightings_in_plane
        camera = next(role for role in CAMERAS if role in car.topics)
        leads: dict[Role, Lead | None] = {}
        if truth is not None:
            for role, signals in moved.items():
                each = [lead_of_motion(s, r) for s, r in zip(signals, truth[:2], strict=True) if s is not None]
                leads[role] = min((lead for lead in each if lead), key=lambda lead: lead.error, default=None)
            leads[camera] = lead_of_bearings(*seen, car.lever[:2], truth[2])
        else:
            turned = turn_of(*seen)
            known = {role: turn for role, (_, turn) in moved.items() if turn is not None}
            leads |= {role: lead_of_motion(turn, turned, PARALLAX) for role, turn in known.items()} if turned else {}
        reference = f"the camera of {car.name}" if truth is None else TRUTH
        found |= {car.topics[r]: replace(lead, first=r.value, reference=reference) for r, lead in leads.items() if lead}
    return found


ODOMETRY = (Role.WHEEL, Role.IMU, Role.ODOMETRY)


def _cumulated(car: CarStreams, role: Role) -> tuple[SampledSignal | None, SampledSignal | None]:
    """Return cumulated distances and turns of a topic; None: it does not measure them."""
    distance, turn = (
        SampledSignal.of_rates(car.tracks[time], values) if car.is_of(time, role) and np.ptp(values) > 0.0 else None
        for time, values in (("wheel_time", car.tracks["wheel"].real), ("gyro_time", car.tracks["gyro"]))
    )
    return distance, turn


def _path(tracks: Mapping[str, Any]) -> tuple[SampledSignal, SampledSignal, SampledSignal] | None:
    """Return distance, heading and path (x, y, heading) by motion capture; None: there is none."""
    t, place, heading = tracks["truth_time"], tracks["truth"], np.unwrap(tracks["truth_yaw"])
    if len(t) < FEWEST:
        return None
    forward = (np.diff(place) * np.exp(-0.5j * (heading[1:] + heading[:-1]))).real
    path = SampledSignal(t, np.column_stack([place.real, place.imag, heading]))
    return SampledSignal(t, np.concatenate([[0.0], np.cumsum(forward)])), SampledSignal(t, heading), path


def moves_of(
    leads: Leads, topics: Sequence[Chosen], tolerance: float, fixed: Set[str], delays: Mapping[str, float]
) -> dict[str, int]:
    """Return the corrections of topics' stamps, ns, so that they agree with their reference up to a tolerance, s.

    The `fixed` ones stay. Where more topics with small `delays` behind sources, s, agree with each other than with
    the reference, that is moved. Odometry without a lead goes with other odometry of its car that has the same delay.
    """
    found: dict[str, float] = {}
    usual = {topic for topic, delay in delays.items() if abs(delay) <= tolerance}
    cars = {entry.topic: entry.car for entry in topics if entry.role in ODOMETRY}
    own = {topic: lead for topic, lead in leads.items() if lead.error <= 2.0 * STEP}
    for reference in {lead.reference for lead in own.values()}:
        moved = [entry.topic for entry in topics if reference == entry.clock]
        group = {topic: lead for topic, lead in own.items() if lead.reference == reference}
        agreed = sorted((lead.seconds for topic, lead in group.items() if topic in usual), key=abs)
        offsets = [*([0.0] if usual & set(moved) else []), *agreed]
        near = [[other for other in offsets if abs(other - offset) <= tolerance] for offset in offsets]
        common = float(np.median(max(near, key=len, default=[0.0])))
        common = 0.0 if abs(common) <= tolerance or fixed & set(moved) else common
        found |= dict.fromkeys(moved, -common) if common else {}
        for topic, lead in group.items():
            rest = replace(lead, seconds=lead.seconds - common)
            found |= {topic: rest.seconds} if rest.exceeds(tolerance) else {}
    for topic in (delays.keys() & cars.keys()) - own.keys():
        same = sorted(t for t in found.keys() & own.keys() if cars.get(t) == cars[topic])
        if same and abs(delays[same[0]] - delays[topic]) <= tolerance:
            found[topic] = found[same[0]]
    return {topic: round(seconds * 1e9) for topic, seconds in found.items() if topic not in fixed}
