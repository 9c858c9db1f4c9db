"""Turn rates that never change while something else shows that the car turns: a dead gyro, wheels that measure none."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from coopenv.estimation.poses import Array

TURNED = math.radians(10.0)  # of a car, by anything else than its turn rate
WINDOW, NOISE, SIGNIFICANT = 0.4, math.radians(2.0), 3.0
"""s over which bearings are compared, rad by which they change for another reason than a turn, and standard errors."""
TRIM = 0.1  # rad of steering with which a car may drive straight on


def constant_turn_rate(
    tracks: Mapping[str, Any], sightings: tuple[Array, Array, Array], wheelbase: float
) -> str | None:
    """Return in words what contradicts a turn rate that is the same in all messages of a car; None: nothing does.

    Args:
        tracks: of a car, see `coopenv.cars.messages.readings.tracks_of`.
        sightings: as of `CarStreams.sightings_in_plane`.
        wheelbase: of the car, m.
    """
    rates = tracks["gyro"]
    if len(rates) < 2 or np.ptp(rates) > 0.0:
        return None
    rate, deg = float(rates[0]), math.degrees
    found = [f"{name} by {deg(turn):.0f} deg" for name, turn in _turns(tracks, sightings, wheelbase, rate)]
    if not found:
        return None
    return f"is {rate:g} rad/s in all {len(rates)} messages, while {' and '.join(found)}"


def _turns(
    tracks: Mapping[str, Any], sightings: tuple[Array, Array, Array], wheelbase: float, rate: float
) -> Iterator[tuple[str, float]]:
    """Yield what turns by more than `TURNED`, beyond a constant rate (rad/s), and by how much (rad)."""
    heading = median_filter(np.unwrap(tracks["truth_yaw"]) - rate * tracks["truth_time"], 5, mode="nearest")
    commanded = _commanded(tracks, wheelbase, rate)
    for name, turn in (
        ("motion capture turns it", float(np.ptp(heading)) if len(heading) else 0.0),
        ("commands turn it", float(np.ptp(commanded)) if len(commanded) else 0.0),
        ("bearings turn it", _inwards(*sightings, tracks) if rate == 0.0 else 0.0),
    ):
        if turn > TURNED:
            yield name, turn


def _commanded(tracks: Mapping[str, Any], wheelbase: float, rate: float) -> Array:
    """Return the heading (n,) by the commanded steering and the speed of the wheels, less that of a constant rate."""
    t = tracks["command_time"]
    if not len(t) or not len(tracks["wheel_time"]):
        return np.zeros(0)
    speed = np.interp(t, tracks["wheel_time"], tracks["wheel"].real, left=0.0, right=0.0)
    steering = tracks["command_steering"][:-1]
    turning = speed[:-1] * np.tan(np.where(np.abs(steering) > TRIM, steering, 0.0)) / wheelbase - rate
    return np.concatenate([[0.0], np.cumsum(turning * np.minimum(np.diff(t), WINDOW))])


def _inwards(times: Array, azimuths: Array, places: Array, tracks: Mapping[str, Any]) -> float:
    """Return by how much a landmark comes nearer to the axis of a car's motion, rad, beyond the noise of its bearings.

    Without a turn, translation moves bearings away from that axis. Means over adjacent windows are compared.
    """
    most = 0.0
    for place in np.unique(places, axis=0):
        own = (places == place).all(axis=1)
        t, azimuth = times[own], np.unwrap(azimuths[own])
        windows, number = np.unique(np.floor((t - t[0]) / WINDOW), return_inverse=True)
        count = np.bincount(number)
        mean = np.bincount(number, azimuth) / count
        variance = np.bincount(number, (azimuth - mean[number]) ** 2) / count**2
        error = np.sqrt(variance[1:] + variance[:-1])  # of a change; it contains the motion within a window, too
        middle = t[0] + WINDOW * (windows + 0.5)
        forwards = np.interp(middle[1:], tracks["wheel_time"], tracks["wheel"].real) if len(tracks["wheel"]) else 0.0
        nearer = -np.diff(mean) * np.sign(np.sin(mean[:-1])) * np.where(np.asarray(forwards) < 0.0, -1.0, 1.0)
        there = (np.diff(windows) == 1.0) & (count[1:] > 1) & (count[:-1] > 1)
        most = max(most, float((there * np.maximum(nearer - NOISE - SIGNIFICANT * error, 0.0)).sum()))
    return most
