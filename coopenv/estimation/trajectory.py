"""The record of a run: true and estimated poses, sight and rewards of every tick."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, get_type_hints

import numpy as np

from coopenv.base.columns import Columns, Tabular, facts_html, one_line, picture_html
from coopenv.base.errors import DataError, check_one_of
from coopenv.base.files import replacing_file
from coopenv.base.format import read_npz
from coopenv.base.installation import load_reference
from coopenv.estimation.poses import error_dof, position_covariance, roll_pitch_yaw_deg

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class RecordedGeometry:
    """Poses of vehicles and targets, and visibility; axes as in `Trajectory`."""

    t: Annotated[np.ndarray, "f K"]  # s
    position: Annotated[np.ndarray, "f K N 3"]  # m, map frame
    target_position: Annotated[np.ndarray, "f K T 3"]  # m, truth
    visible: Annotated[np.ndarray, "b K N T"]  # measured in this frame
    vehicles: Annotated[np.ndarray, "U N"]  # names


@dataclass(frozen=True, eq=False)
class Trajectory(RecordedGeometry, Tabular):
    """K camera ticks (t = 0 included) of N vehicles and T targets (landmarks first, then vehicles).

    Each array is annotated with the kinds of its dtype and its axes; there are R reward terms.

    Frames: `position*` in the map frame; `rotation*` maps body to map; velocities in the body frame;
    `covariance` is the observer's P over (2 lambda, p), p being the position in the body frame.

    As a table it has a row per tick and vehicle: `to_pandas`, `to_polars`, `to_xarray`, `to_csv` and `to_parquet`.
    """

    _PARTS = "vehicles"
    rotation: Annotated[np.ndarray, "f K N 3 3"]  # true, body to map
    position_estimate: Annotated[np.ndarray, "f K N 3"]  # m
    rotation_estimate: Annotated[np.ndarray, "f K N 3 3"]  # body to map
    position_error: Annotated[np.ndarray, "f K N"]  # m
    orientation_error: Annotated[np.ndarray, "f K N"]  # deg, geodesic
    covariance: Annotated[np.ndarray, "f K N 6 6"]  # rad^2, rad m, m^2
    nees: Annotated[np.ndarray, "f K N"]  # e^T P^-1 e, e and P in the coordinates in which the observer states P
    protection_level: Annotated[np.ndarray, "f? K N 2"]  # m, rad; infinite: unknown, or none is stated
    velocity: Annotated[np.ndarray, "f K N 3"]  # m/s, truth
    angular_velocity: Annotated[np.ndarray, "f K N 3"]  # rad/s, truth
    sight: Annotated[np.ndarray, "iu K N T"]  # uint8, values of `Sight`
    reward_terms: Annotated[np.ndarray, "f K N R"]  # of the tick: as if each tick were a decision
    terms: Annotated[np.ndarray, "U R"]  # names of the terms
    targets: Annotated[np.ndarray, "U T"]  # names
    target_moving: Annotated[np.ndarray, "b T"]  # vehicles and moving landmarks

    @property
    def nees_dof(self) -> int:
        """Degrees of freedom of `nees`: 6, or 3 where no error leaves a plane, as of robots with planar estimates."""
        return error_dof(self.rotation, self.position, self.rotation_estimate, self.position_estimate)

    def columns(self) -> Columns:
        """Return a row per tick and vehicle; `_std_` are of the position in the map frame, from P to first order."""
        P = position_covariance(self.rotation_estimate, self.position_estimate, self.covariance)
        std, N = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1)), len(self.vehicles)
        parts = {
            "x_m y_m z_m": self.position,
            "roll_deg pitch_deg yaw_deg": roll_pitch_yaw_deg(self.rotation),
            "x_estimate_m y_estimate_m z_estimate_m": self.position_estimate,
            "roll_estimate_deg pitch_estimate_deg yaw_estimate_deg": roll_pitch_yaw_deg(self.rotation_estimate),
            "x_std_m y_std_m z_std_m": std,
            "position_error_m": self.position_error,
            "orientation_error_deg": self.orientation_error,
            "nees": self.nees,
            "protection_level_m protection_level_rad": self.protection_level,
            "velocity_x_m_per_s velocity_y_m_per_s velocity_z_m_per_s": self.velocity,
            "turn_x_rad_per_s turn_y_rad_per_s turn_z_rad_per_s": self.angular_velocity,
            "targets_in_view": self.visible.sum(axis=-1),
            " ".join(f"reward_{term}" for term in self.terms): self.reward_terms,
        }
        values = {"t_s": np.repeat(self.t, N), "vehicle": np.tile(self.vehicles, len(self.t))}
        for names, array in parts.items():
            values |= dict(zip(names.split(), array.reshape(len(self.t) * N, -1).T, strict=True))
        return Columns(values, ("t_s", "vehicle"))

    def __getitem__(self, vehicle: str) -> Self:
        """Return the record of one vehicle. Raises CoopenvError: there is none of that name."""
        names = self.vehicles.tolist()
        check_one_of("unknown vehicle", vehicle, names)
        return self.of_vehicles([names.index(vehicle)])

    def __repr__(self) -> str:
        facts = {"ticks": len(self.t), "vehicles": len(self.vehicles), "targets": len(self.targets)}
        return one_line(self, f"{self.t[0]:g} to {self.t[-1]:g} s", facts)

    def _repr_html_(self) -> str:
        arrays = {name: f"{(array := getattr(self, name)).dtype} {array.shape}" for name in self.kinds()}
        picture = picture_html(self.figure(width=6.0)) if self.with_truth(range(len(self.vehicles))) else ""
        return facts_html(repr(self), arrays) + picture

    def figure(self, kind: str = "trajectories_2d", **options: Any) -> "Figure":
        """Return a figure of `coopenv.viz.FIGURE_NAMES`; options and errors as of `coopenv.viz.figures.draw_figure`."""
        drawn: Figure = load_reference("coopenv.viz.figures:draw_figure")(kind, self, **options)  # which stand on this
        return drawn

    def where_truth_is_known(self) -> Self:
        """Return the ticks at which every vehicle's true pose is known, as it may not be in a recording."""
        known = self._truth_known.all(axis=1)
        return self if known.all() else self._along("K", known)

    @property
    def _truth_known(self) -> np.ndarray:
        """(K, N) whether the true pose is known."""
        return np.asarray(np.isfinite(self.position).all(axis=-1) & np.isfinite(self.rotation).all(axis=(-2, -1)))

    def with_truth(self, vehicles: Sequence[int]) -> list[int]:
        """Return the geometry of some vehicles with known true poses, at two ticks or more; None without common ticks.

        Of cars without motion capture nothing is known; if so of some, the others have errors all the same.
        """
        known = self._truth_known
        chosen = [i for i in vehicles if known[:, i].sum() > 1]
        return chosen if known[:, chosen].all(axis=1).sum() > 1 else []

    def of_vehicles(self, indices: Sequence[int]) -> Self:
        """Return the record of some vehicles alone; the others stay among the targets."""
        return self if [*indices] == [*range(len(self.vehicles))] else self._along("N", [*indices])

    def without_targets(self, names: Collection[str]) -> Self:
        """Return the record without some of its targets."""
        return self._along("T", [name not in names for name in self.targets.tolist()]) if names else self

    def _along(self, axis: str, chosen: Any) -> Self:
        """Return the record with the chosen entries of an axis, in every array that has it."""
        places = {name: kinds.split()[1:] for name, kinds in self.kinds().items()}
        arrays = {name: (getattr(self, name), axes.index(axis)) for name, axes in places.items() if axis in axes}
        return replace(self, **{name: array[(slice(None),) * k + (chosen,)] for name, (array, k) in arrays.items()})

    @classmethod
    def kinds(cls) -> dict[str, str]:
        """Return the kinds of the dtype and the axes of every array, by name, as `read_npz` takes them."""
        hints = get_type_hints(cls, include_extras=True)
        return {name: hint.__metadata__[0] for name, hint in hints.items()}

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
        found = cls(**read_npz(path, "trajectory", cls.kinds()))
        if not len(found.t) or not np.isfinite(found.t).all() or (np.diff(found.t) < 0.0).any():
            raise DataError(f"{path}: t: expected finite times, s, in order")
        return found
