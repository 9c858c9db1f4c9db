"""Kinds of measurements: their interface, and the table of all shipped ones."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coopenv.base.errors import check_one_of
from coopenv.estimation.poses import Array, skew

MOST_ROWS = 6  # of a kind, and numbers of its value
STEP = 1e-3
"""rad and m, of differences, whose error is of the fourth order: 1e-11 for a range of 50 m."""
STEPS = {1.0: 2.0 / 3.0, -1.0: -2.0 / 3.0, 2.0: -1.0 / 12.0, -2.0: 1.0 / 12.0}  # weights of values at such steps


@dataclass(frozen=True)
class Placed:
    """Pose and motion of a sensor, or of what it measures; NaN where not known. A batch has leading axes (...)."""

    position: Array  # (..., 3) map, m
    rotation: Array  # (..., 3, 3) own axes to map
    velocity: Array  # (..., 3) map axes, m/s
    angular_velocity: Array  # (..., 3) own axes, rad/s
    landmarks: Mapping[str, Array] = field(default_factory=dict)
    """Positions (3,) by name on the vehicle's map, m, of a sensor; (..., 3) if they move within a batch."""

    @classmethod
    def at(cls, position: Array, rotation: Array | None = None) -> "Placed":
        """Return what stands at positions (..., 3), with the map's axes if there is no rotation (..., 3, 3)."""
        position = np.asarray(position, dtype=np.float64)
        axes = np.broadcast_to(np.eye(3), (*position.shape, 3)) if rotation is None else rotation
        return cls(position, axes, np.zeros_like(position), np.zeros_like(position))

    def moved(self, error: Array) -> "Placed":
        """Return it turned about its own axes, and shifted along the map's, by a small error (..., 6) in rad and m.

        Velocity and axes turn together: a vehicle knows its velocity in its own axes.
        """
        turned = self.rotation @ exponential(error[..., :3])
        with_it = turned @ np.swapaxes(self.rotation, -1, -2)
        velocity = (with_it @ self.velocity[..., None])[..., 0]
        return replace(self, position=self.position + error[..., 3:], rotation=turned, velocity=velocity)

    def repeated(self, count: int) -> "Placed":
        """Return a batch (count, ...) of this one."""
        batch = (count, *self.position.shape[:-1])
        arrays: dict[str, Any] = {
            name: np.broadcast_to(getattr(self, name), (*batch, *of)) for name, of in SHAPES.items()
        }
        return replace(self, **arrays)

    def each(self) -> Iterator["Placed"]:
        """Yield the entries of a batch."""
        shape = self.position.shape[:-1]
        parts: list[Any] = [
            np.broadcast_to(getattr(self, name), (*shape, *of)).reshape(-1, *of) for name, of in SHAPES.items()
        ]
        moving = {
            name: np.broadcast_to(at, (*shape, 3)).reshape(-1, 3)
            for name, at in self.landmarks.items()
            if np.ndim(at) > 1
        }
        for n in range(len(parts[0])):
            marks = self.landmarks
            if moving:
                marks = Landmarks({**marks, **{name: at[n] for name, at in moving.items()}})
            position, rotation, velocity, turning = (part[n] for part in parts)
            yield Placed(position, rotation, velocity, turning, marks)


class Landmarks(dict[str, Array]):
    """Positions of landmarks by name."""

    def __missing__(self, name: str) -> Array:
        """Refuse an unknown name. Raises CoopenvError: it names the known ones."""
        check_one_of("own.landmarks: unknown landmark", name, self)
        raise KeyError(name)


SHAPES = {"position": (3,), "rotation": (3, 3), "velocity": (3,), "angular_velocity": (3,)}
"""Of the arrays of `Placed`, without leading axes."""


def exponential(w: Array) -> Array:
    """Return Exp(w) (..., 3, 3), rotations by |w| rad about w (..., 3)."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    S = skew(w)
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * S + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * S @ S)


def logarithm(R: Array) -> Array:
    """Return the rotation vectors (..., 3) of rotations (..., 3, 3), rad; NaN where a rotation is."""
    known = np.asarray(np.isfinite(R).all(axis=(-1, -2)))
    vectors = Rotation.from_matrix(np.where(known[..., None, None], R, np.eye(3)).reshape(-1, 3, 3)).as_rotvec()
    return np.where(known[..., None], vectors.reshape(R.shape[:-1]), np.nan)


class WarpFunctions(NamedTuple):
    """A kind in kernels: Warp functions in any precision, in the conventions of `Kind`, of one measurement.

    Values, noise and residuals are vectors of six numbers, zero beyond their size.
    """

    predict: Any
    """(own rotation, position, velocity, target rotation, position, velocity, empty value): return the value; arguments
    as the fields of `Placed`, rotations (3, 3), the others (3,)."""
    sample: Any
    """(predicted value, noise, a vector (3,) for its type): return the measured value."""
    residual: Any = None
    """(value, predicted value, a vector (3,) for its type): return the rows. None: no observer in kernels takes it."""
    jacobian: Any = None
    """(as `predict`, without the last): return the derivatives (6, 6) by errors of the sensor and of the target; rows
    beyond the kind's are zero."""


class Kind(ABC):
    """A kind of measurement; arrays may have leading axes (...) of a batch.

    A shipped kind computes batches; `coopenv.measurements.own` makes a kind of a user's class, which computes one
    measurement at a time.
    """

    rows: int  # of the residual, 1 to 6
    size: int  # of the value, 1 to 6
    has_target = True  # False: it measures the map, as a receiver of satellites does
    noise: tuple[float, ...]  # (rows,) standard deviations where a scenario states no other
    units: tuple[str, ...]  # (rows,) of the residual
    towards: tuple[str, ...] = ("landmarks", "vehicles")  # what it measures where a scenario does not say
    needs: tuple[str, ...] = ()  # "rotation" and "velocity": what it has to know of a target beside the position
    drawn: Literal["line", "cross", "none"] = "line"  # in pictures: a line to its target, a cross on the sensor, or not
    under_sky = False  # True: what hides the sky above it occludes it, as for a receiver of satellites
    in_warp: WarpFunctions | None = None  # None: it is computed in NumPy alone

    @abstractmethod
    def predict(self, own: Placed, target: Placed) -> Array:
        """Return values (..., size) without noise; `target` is the map's origin where the kind has no target."""

    @property
    def parts(self) -> tuple[tuple[str, int, str], ...]:
        """Name, size and unit of the parts of a value: the whole, without a name, or each number by its own unit."""
        if self.size != self.rows or len({*self.units}) == 1:
            return (("", self.size, self.units[0]),)
        return tuple((str(number), 1, unit) for number, unit in enumerate(self.units, 1))

    def residual(self, value: Array, predicted: Array) -> Array:
        """Return (..., rows) by how much values exceed predicted ones, to first order linear in errors."""
        return value - predicted

    def jacobian(self, own: Placed, target: Placed) -> tuple[Array, Array]:
        """Return the derivatives (..., rows, 6) of a value by errors of the sensor and of the target.

        An error turns about own axes (rad) and shifts along the map's axes (m), see `Placed.moved`.
        """
        return self.differences(own, target)

    def sample(self, predicted: Array, noise: Array) -> Array:
        """Return measured values (..., size): predicted ones with a drawn noise (..., rows)."""
        return predicted + noise

    def sensed(self, own: Placed, target: Placed) -> NDArray[np.bool_]:
        """Return (...) whether a target can be measured, beside range, field of view and occlusion."""
        return np.ones(own.position.shape[:-1], bool)

    def differences(self, own: Placed, target: Placed) -> tuple[Array, Array]:
        """Return the derivatives of `jacobian` by central differences of the fourth order."""
        value, count = self.predict(own, target), 6 * len(STEPS)
        errors = (STEP * np.array([*STEPS])[:, None, None] * np.eye(6)).reshape(
            count, *[1] * (own.position.ndim - 1), 6
        )
        weights = np.array([*STEPS.values()]) / STEP

        def derivative(own: Placed, target: Placed) -> Array:
            change = self.residual(self.predict(own, target), np.broadcast_to(value, (count, *value.shape)))
            return np.asarray(np.einsum("s,sa...->...a", weights, change.reshape(len(STEPS), 6, *change.shape[1:])))

        by_own = derivative(own.moved(errors), target.repeated(count))
        by_target = derivative(own.repeated(count), target.moved(errors)) if self.has_target else np.zeros_like(by_own)
        return by_own, by_target


def unit(v: Array) -> tuple[Array, Array]:
    """Return the unit vectors (..., 3) along v and the lengths (..., 1)."""
    length = np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)
    return v / length, length


def in_axes(rotation: Array, v: Array) -> Array:
    """Return map vectors (..., 3) in axes (..., 3, 3) that a rotation turns to the map."""
    return np.asarray((np.swapaxes(rotation, -1, -2) @ v[..., None])[..., 0])


def derivatives(by_turn: Any, by_shift: Array) -> Array:
    """Return a derivative (..., rows, 6) of its halves; a turn without effect is None."""
    return np.concatenate([np.zeros_like(by_shift) if by_turn is None else by_turn, by_shift], axis=-1)
