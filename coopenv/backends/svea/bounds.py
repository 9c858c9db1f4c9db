"""Where cars may be: inside the fence, and apart from one another."""

from collections.abc import Collection, Iterator

import numpy as np

from coopenv.backends.svea.vitals import Vitals
from coopenv.estimation.arrays import Array
from coopenv.svea.deployment import Safety
from coopenv.svea.fence import inside


def misplaced(
    safety: Safety, vitals: Vitals, cars: Collection[str], others: Collection[str]
) -> Iterator[tuple[str, str]]:
    """Yield the car and what is wrong with where it is, in words.

    Args:
        safety: fence, separation, and how old a place may be.
        vitals: knows where the cars are.
        cars: those that are driven here: each has to be inside the fence.
        others: those that are not; the former have to be apart from all.
    """
    apart = safety.separation > 0.0
    watched = [*cars, *others] if apart else [*cars] if safety.geofence else []
    for car in watched:
        never = car not in vitals.places
        if vitals.lost(car) > safety.truth_age or (never and safety.judge == "truth"):
            since = "is not known" if never else f"has not been known for {vitals.lost(car):.2f} s"
            by = [
                name for name, judged in (("fence", safety.geofence and car in cars), ("separation", apart)) if judged
            ]
            yield car, f"its place {since}: {' and '.join(by)} cannot be judged"
    places = {car: vitals.places[car].position for car in watched if car in vitals.places}
    for car in cars:
        if safety.geofence and car in places:
            x, y = float(places[car][0]), float(places[car][1])
            if not inside(safety.geofence, x, y):
                yield car, f"left the geofence at ({x:.2f}, {y:.2f}) m"
    if safety.separation > 0.0:
        yield from _too_close(safety.separation, places, cars)


def _too_close(least: float, places: dict[str, Array], cars: Collection[str]) -> Iterator[tuple[str, str]]:
    names = list(places)
    for i, car in enumerate(names):
        for other in names[i + 1 :]:
            distance = float(np.linalg.norm(places[car][:2] - places[other][:2]))
            if distance < least and (car in cars or other in cars):
                yield car, f"{distance:.2f} m from {other}, {least:g} m is the least"
