"""The record of one run: what was true, what was estimated, and what was in view."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self

import numpy as np

from coopenv.base.files import replacing_file
from coopenv.base.sections import read_npz


@dataclass(frozen=True)
class Trajectory:
    """K camera ticks (t = 0 included) of N vehicles and T targets (landmarks first, then vehicles).

    Frames: `position*` in the map frame; `rotation*` maps body to map; velocities in the body frame;
    `covariance` is the observer's P over (2 lambda, p), p being the position in the body frame.
    """

    t: np.ndarray  # (K,) s
    position: np.ndarray  # (K, N, 3) m
    rotation: np.ndarray  # (K, N, 3, 3)
    position_estimate: np.ndarray  # (K, N, 3) m
    rotation_estimate: np.ndarray  # (K, N, 3, 3)
    position_error: np.ndarray  # (K, N) m
    orientation_error: np.ndarray  # (K, N) deg, geodesic
    covariance: np.ndarray  # (K, N, 6, 6) rad^2, rad m, m^2
    nees: np.ndarray  # (K, N)
    velocity: np.ndarray  # (K, N, 3) m/s, truth
    angular_velocity: np.ndarray  # (K, N, 3) rad/s, truth
    target_position: np.ndarray  # (K, T, 3) m, truth
    visible: np.ndarray  # (K, N, T) bool
    sight: np.ndarray  # (K, N, T) uint8, values of `Sight`
    reward_terms: np.ndarray  # (K, N, R) of the tick: as if each tick were a decision
    terms: np.ndarray  # (R,) names of the terms
    vehicles: np.ndarray  # (N,) names
    targets: np.ndarray  # (T,) names
    target_moving: np.ndarray  # (T,) bool: vehicles and moving landmarks

    def where_truth_is_known(self) -> Self:
        """Return the ticks at which every vehicle's true pose is known, as it may not be in a recording."""
        known = np.isfinite(self.position).all(axis=(1, 2)) & np.isfinite(self.rotation).all(axis=(1, 2, 3))
        if known.all():
            return self
        constant = ("terms", "vehicles", "targets", "target_moving")
        return replace(self, **{f.name: getattr(self, f.name)[known] for f in fields(self) if f.name not in constant})

    def of_vehicles(self, indices: Sequence[int]) -> Self:
        """Return the record of some vehicles alone; the others stay among the targets."""
        if [*indices] == [*range(len(self.vehicles))]:
            return self
        of_all = ("t", "target_position", "terms", "targets", "target_moving")
        chosen = {
            f.name: getattr(self, f.name)[:, [*indices]] for f in fields(self) if f.name not in (*of_all, "vehicles")
        }
        return replace(self, vehicles=self.vehicles[[*indices]], **chosen)

    def save(self, path: Path) -> None:
        """Write every array into a compressed `.npz` under its field name.

        Raises:
            OutputError: it cannot be written; an older file is untouched.
        """
        with replacing_file(path) as new, new.open("wb") as stream:
            np.savez_compressed(stream, **{f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file written by `save`.

        Raises:
            DataError: the file is no such record, an array is missing or of another shape, or it is too large.
        """
        return cls(**read_npz(path, "trajectory", _TABLE))


_TABLE = {
    "t": "f K",
    **dict.fromkeys(("position", "position_estimate", "velocity", "angular_velocity"), "f K N 3"),
    **dict.fromkeys(("rotation", "rotation_estimate"), "f K N 3 3"),
    **dict.fromkeys(("position_error", "orientation_error", "nees"), "f K N"),
    "covariance": "f K N 6 6",
    "target_position": "f K T 3",
    "visible": "b K N T",
    "sight": "iu K N T",
    "reward_terms": "f K N R",
    "terms": "U R",
    "vehicles": "U N",
    "targets": "U T",
    "target_moving": "b T",
}
"""By field the kinds of its dtype and its axes, as `Trajectory` names them."""
