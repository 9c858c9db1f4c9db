"""Conventions of motion capture: candidates by which its poses are not those of a body in a map whose z axis is up.

Each candidate is a transformation of all poses. The one is named with which more of bearings, gyro and wheels agree
than as given. Poses of a car that drives on a floor are upright, which leaves few candidates to try.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product
from operator import itemgetter

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.base.errors import listed
from coopenv.cars.doctor.finding import Diagnosis, Finding, Treatment
from coopenv.cars.doctor.motion import FOLLOWS, turning_factor, velocity_relations
from coopenv.cars.doctor.sight import BAD, sight_of, thinned
from coopenv.cars.doctor.streams import CarStreams
from coopenv.cars.settings.profile import Role
from coopenv.estimation.poses import Array

first = itemgetter(0)
FEW, TRIED = 50, 6
"""Poses that show whether a convention is upright, and conventions that are compared with gyro and wheels."""
UPRIGHT = 0.966
"""Cosine of 15 deg, median tilt up to which poses are those of a car on a floor."""
ALIKE = 0.3
"""Relative difference of turn rates and speeds from motion capture with which these agree."""
ORDERS = {"": [0, 1, 2, 3], "its quaternions are in the order w, x, y, z": [1, 2, 3, 0]}
"""Fields x, y, z, w of a message in the order in which they hold x, y, z, w."""
INVERSE = "its poses are inverse: those of the map in the body's frame"
BODIES = {
    "": (False, False),
    "its poses are those of the camera's optical frame": (True, True),
    "its positions are those of the camera": (True, False),
}
"""Whether positions, and orientations, are those of the camera."""


def _axes() -> dict[str, list[Array]]:
    """Return rotations to a map whose z axis is up, by the axis that is up; those of a common axis differ in yaw."""
    found: dict[str, list[Array]] = {"z": [np.eye(3)]}
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.array(signs)[:, None] * np.eye(3)[list(order)]
        if order[2] != 2 and np.linalg.det(matrix) > 0.0:
            found.setdefault(("" if signs[2] > 0.0 else "-") + "xyz"[order[2]], []).append(matrix)
    return found


AXES = _axes()


@dataclass(frozen=True)
class Convention:
    """A candidate."""

    order: str
    inverse: bool
    up: str
    axes: Array
    """(3, 3) to the map's axes."""
    both: bool
    """Whether the body has these axes, too."""
    body: str

    @property
    def text(self) -> str:
        """The convention in words; empty: that of this program, but for a yaw."""
        axis = "" if self.up == "z" else f"its axis {self.up} is up"
        return ", and ".join(filter(None, (self.order, INVERSE * self.inverse, axis, self.body)))

    def poses(self, car: CarStreams, rows: slice = slice(None)) -> Array:
        """Return the poses (n, 3, 4) of a body by those that motion capture states."""
        given, (lever, optical) = car.tracks["truth_pose"][rows], BODIES[self.body]
        quaternion, place = Rotation.from_matrix(given[:, :, :3]).as_quat(), given[:, :, 3:]
        R = Rotation.from_quat(quaternion[:, ORDERS[self.order]]).as_matrix()
        if self.inverse:
            R = R.transpose(0, 2, 1)
            place = -R @ place
        R = self.axes @ R @ (self.axes.T if self.both else np.eye(3))
        R = R @ car.mounting.T if optical else R
        place = self.axes @ place - (R @ car.lever[:, None] if lever else 0.0)
        return np.concatenate([R, place], axis=-1)


def conventions(car: CarStreams) -> Iterator[Convention]:
    """Yield the conventions by which the poses of a car are upright, those with few changes first."""
    few = slice(None, None, 1 + len(car.tracks["truth_pose"]) // FEW)
    for body, order, inverse, (up, matrices) in product(BODIES, ORDERS, (False, True), AXES.items()):
        for matrix, both in product(matrices, (False, True) if up != "z" else (False,)):
            candidate = Convention(order, inverse, up, matrix, both, body)
            if candidate.text and np.median(candidate.poses(car, few)[:, 2, 2]) > UPRIGHT:
                yield candidate


def agreement(car: CarStreams) -> list[str]:
    """Return which streams agree with motion capture."""
    found, signals = [], car.truth_signals
    if (few := thinned(car)) is not None and sight_of(few).misfit() < BAD:
        found.append("bearings")
    turned, (moved, _) = (
        (turning_factor(car, signals[1]), velocity_relations(car, *signals)) if signals else (None, (None, None))
    )
    for what, factor in (("turn rates", turned), ("velocities", moved)):
        if factor is not None and factor.explained > FOLLOWS and abs(factor.factor - 1.0) < ALIKE:
            found.append(what)
    return found


def of_conventions(car: CarStreams) -> Iterator[Diagnosis]:
    """Yield the convention of motion capture with which other streams agree, if these do not as given."""
    if car.truth_signals is None or "truth_pose" not in car.tracks:
        return
    given = agreement(car)
    if "bearings" in given or (len(given) > 1 and thinned(car) is None):
        return
    best: dict[str, tuple[float, Convention]] = {}  # those of one text differ in yaw, on which bearings decide
    for candidate in conventions(car):
        few = thinned(car.with_poses(candidate.poses(car)))
        misfit = 0.0 if few is None else sight_of(few).misfit()
        best[candidate.text] = min(best.get(candidate.text, (np.inf, candidate)), (misfit, candidate), key=first)
    tried = [(agreement(car.with_poses(one.poses(car))), one) for _, one in sorted(best.values(), key=first)[:TRIED]]
    agreeing, one = max(tried, key=lambda entry: len(entry[0]), default=(given, None))
    if one is not None and len(agreeing) > max(1, len(given)):
        text = f"motion capture of {car.name} has other conventions: {one.text}. "
        text += f"With that, {listed(agreeing)} agree with it, and as given {listed(given) or 'no stream'}"
        about = Finding(car.topic([Role.TRUTH]), text, treatment=Treatment.REFUSED, car=car.name)
        yield Diagnosis(about, lambda car: car.with_poses(one.poses(car)))
