"""The record of one run: what was true, what was estimated, and what was in view."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self
from zipfile import BadZipFile

import numpy as np

from coopenv.base.errors import DataError
from coopenv.base.files import replacing_file


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
            DataError: the file is no such record, or arrays are missing.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                missing = [f.name for f in fields(cls) if f.name not in data]
                if missing:
                    raise DataError(f"{path}: not a trajectory, arrays missing: {', '.join(missing)}")
                return cls(**{f.name: data[f.name] for f in fields(cls)})
        except DataError:
            raise
        except (BadZipFile, EOFError, zlib.error):
            raise DataError(f"{path}: not a readable .npz file: it is cut off or damaged, or was never one") from None
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or error
            raise DataError(f"{path}: not a readable .npz file ({why})") from None
