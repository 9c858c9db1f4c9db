"""Where the vehicles of a scene stand, how they move and whom they measure.

Nobody leaves the scene: streets are driven to and fro, everything else goes round in circles. The lane and the two
streets are, until they first turn round, those on which deep graphs were found to break observers.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

LANDMARKS = {"SL1": (-4.0, 5.0, 3.0), "SL2": (4.0, 4.0, 5.0), "SL3": (4.0, -3.0, 4.0)}
"""Name to position, m; as in busy_intersection."""

TARGETS = 3
"""Bearings with which a pose is observable; who measures fewer vehicles measures landmarks besides."""

NORTH, EAST = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)


class Straight(NamedTuple):
    """To and fro, without turning."""

    velocity: tuple[float, float, float]
    """m/s, body frame."""


class Round(NamedTuple):
    """Forwards on a circle."""

    speed: float
    """m/s"""
    turn: float
    """rad/s, to the left."""


class Placed(NamedTuple):
    """One vehicle."""

    position: tuple[float, float, float]
    """m"""
    yaw: float
    """rad"""
    motion: Straight | Round
    neighbours: tuple[str, ...]


def _filled(vehicles: Sequence[int], first: int = 0) -> tuple[str, ...]:
    """Return the names of vehicles (from 1 on) and of as many landmarks as make `TARGETS`."""
    names = list(LANDMARKS)
    some = [names[(first + n) % len(names)] for n in range(max(0, TARGETS - len(vehicles)))]
    return (*sorted(some), *(f"vehicle_{i}" for i in vehicles))


def _along(direction: tuple[float, float, float], speed: float) -> Straight:
    return Straight((direction[0] * speed, direction[1] * speed, 0.0))


def lane(vehicles: int, seen: int) -> list[Placed]:
    """Return a lane: 3 m from one to the next, all at one speed."""
    placed = []
    for k in range(vehicles):
        side, up = (0.5 * (-1) ** k, 0.3 * (k % 3)) if k else (0.0, 0.0)
        leaders = [i for i in range(k - seen + 1, k + 1) if i >= 1]
        placed.append(Placed((-2.0 + side, -10.0 - 3.0 * k, 2.5 + up), 0.0, _along(NORTH, 0.5), _filled(leaders)))
    return placed


def roots(vehicles: int) -> list[Placed]:
    """Return two streets that cross, odd numbers on that to the north; speeds differ a little."""
    landmarks = tuple(LANDMARKS)
    placed = [
        Placed((-2.0, -16.0, 2.5), 0.0, _along(NORTH, 0.6), landmarks),
        Placed((-17.0, 2.0, 3.0), 0.0, _along(EAST, 0.6), landmarks),
    ]
    for n in range(3, vehicles + 1):
        back, aside = -19.0 - 3.0 * ((n - 3) // 2), 0.3 * (-1) ** (n // 2)
        north = n % 2 == 1
        x, y = (-2.0 + aside, back) if north else (back, 2.0 + aside)
        leaders = {3: (1, 2), 4: (1, 3)}.get(n, (n - 4, n - 3, n - 2))
        speed = 0.5 + 0.02 * ((n - 3) % 8)
        motion = _along(NORTH if north else EAST, speed)
        placed.append(Placed((x, y, 2.0 + 0.5 * (n % 4)), 0.0, motion, _filled(leaders, n - 2)))
    return placed


def tree(vehicles: int, seen: int) -> list[Placed]:
    """Return a binary tree, a level of it on a circle each, whose vehicles go round on small circles of their own."""
    placed = []
    for i in range(1, vehicles + 1):
        line: list[int] = []
        level = i.bit_length() - 1
        while len(line) < min(seen, level):
            line.append((line[-1] if line else i) // 2)
        width = 2**level
        angle = 2.0 * math.pi * (i - width + 0.5) / width
        reach = 9.0 * level + (6.0 if level == 0 else 0.0)
        x, y = reach * math.cos(angle), reach * math.sin(angle)
        motion = Round(0.5, 0.5 / (2.0 + i % 3) * (-1) ** i)
        placed.append(Placed((x, y, 2.0 + 0.5 * (i % 4)), angle, motion, _filled(sorted(line), i)))
    return placed


def random_graph(vehicles: int, seen: int, seed: int) -> list[Placed]:
    """Return vehicles in random places of a square, on circles of 3 to 8 m, each measuring random ones before it."""
    random, half, placed = np.random.default_rng(seed), 3.0 * math.sqrt(vehicles) + 5.0, []
    places: list[np.ndarray] = []
    while len(places) < vehicles:
        place = random.uniform(-half, half, 2)
        if all(np.linalg.norm(place - other) > 3.0 for other in places):
            places.append(place)
    for i, (x, y) in enumerate(places):
        pool = [*LANDMARKS, *(f"vehicle_{j + 1}" for j in range(i))]
        drawn = random.choice(len(pool), min(len(pool), max(seen, TARGETS if i == 0 else 1)), replace=False)
        speed, radius, side = random.uniform(0.4, 0.7), random.uniform(3.0, 8.0), random.choice([-1.0, 1.0])
        z, yaw = random.uniform(1.5, 4.0), random.uniform(-math.pi, math.pi)
        motion = Round(round(float(speed), 3), round(float(side * speed / radius), 5))
        names = tuple(pool[n] for n in sorted(drawn.tolist()))
        placed.append(Placed((float(x), float(y), float(z)), float(yaw), motion, names))
    return placed


def ring(vehicles: int, seen: int) -> list[Placed]:
    """Return vehicles that follow one another on a circle, each with landmarks besides."""
    radius, placed = max(8.0, 3.0 * vehicles / (2.0 * math.pi)), []
    for i in range(vehicles):
        angle = 2.0 * math.pi * i / vehicles
        leaders = sorted((i + n) % vehicles + 1 for n in range(1, seen + 1))
        position = (radius * math.cos(angle), radius * math.sin(angle), 2.0 + 0.5 * (i % 3))
        placed.append(Placed(position, angle + math.pi / 2, Round(0.5, 0.5 / radius), _filled(leaders, i)))
    return placed
