"""A user's own kind of measurement: one class of plain NumPy that computes one measurement at a time."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError, error_text, shown
from coopenv.base.installation import load_reference
from coopenv.estimation.poses import Array
from coopenv.measurements.kinds import MOST_ROWS, Kind, Placed, exponential

AGREEMENT = 1e-4  # of a derivative with differences, relative to its largest entry
TRIALS = 3  # places at which a kind is tried before it is used


class OwnKind(Kind):
    """A user's class as a `Kind`. It has `predict(own, target)` and `noise`, and what else it defines of a kind."""

    def __init__(self, reference: str, options: Mapping[str, Any]) -> None:
        """Load, make and try a class.

        Args:
            reference: `file.py:Class` or `package.module:Class`.
            options: arguments of the class.

        Raises:
            CoopenvError: it cannot be loaded or made, has no `predict`, or what it returns does not fit together.
        """
        self.reference = reference
        made = load_reference(reference)
        if not (inspect.isclass(made) and callable(getattr(made, "predict", None))):
            raise CoopenvError(f"sensor '{reference}': expected a class with predict(own, target), got {shown(made)}")
        self.own = self._call("its start", made, **options)
        self.has_target = bool(getattr(made, "has_target", True))
        self.towards = tuple(getattr(made, "towards", Kind.towards if self.has_target else ("map",)))
        for name in ("in_warp", "drawn", "under_sky"):
            setattr(self, name, getattr(made, name, getattr(Kind, name)))
        self._try()

    def predict(self, own: Placed, target: Placed) -> Array:
        """Return values (..., size), computed one by one."""
        return self._each("predict", self.size, own, target)

    def residual(self, value: Array, predicted: Array) -> Array:
        """Return (..., rows)."""
        if not hasattr(self.own, "residual"):
            return value - predicted
        flat = zip(*(part.reshape(-1, self.size) for part in np.broadcast_arrays(value, predicted)), strict=True)
        rows = [self._checked("residual", self._call("residual", self.own.residual, *pair), self.rows) for pair in flat]
        return np.array(rows).reshape(*value.shape[:-1], self.rows)

    def jacobian(self, own: Placed, target: Placed) -> tuple[Array, Array]:
        """Return the derivatives, of the class or by differences."""
        if not hasattr(self.own, "jacobian"):
            return self.differences(own, target)
        shape = own.position.shape[:-1]
        parts: list[list[Array]] = [[], []]
        for pair in self._pairs(own, target):
            given = self._call("jacobian", self.own.jacobian, *pair)
            halves = given if isinstance(given, tuple) and len(given) == 2 else (given, np.zeros((self.rows, 6)))
            for part, half in zip(parts, halves, strict=True):
                part.append(self._checked("jacobian", half, self.rows, 6))
        by_own, by_target = (np.array(part).reshape(*shape, self.rows, 6) for part in parts)
        return by_own, by_target

    def sample(self, predicted: Array, noise: Array) -> Array:
        """Return measured values (..., size)."""
        if not hasattr(self.own, "sample"):
            return predicted + noise
        flat = zip(predicted.reshape(-1, self.size), noise.reshape(-1, self.rows), strict=True)
        values = [self._checked("sample", self._call("sample", self.own.sample, *pair), self.size) for pair in flat]
        return np.array(values).reshape(predicted.shape)

    def sensed(self, own: Placed, target: Placed) -> NDArray[np.bool_]:
        """Return (...) whether a target can be measured."""
        if not hasattr(self.own, "sensed"):
            return super().sensed(own, target)
        found = [bool(self._call("sensed", self.own.sensed, *pair)) for pair in self._pairs(own, target)]
        return np.array(found, bool).reshape(own.position.shape[:-1])

    def _pairs(self, own: Placed, target: Placed) -> list[tuple[Placed, Placed]]:
        return [(own, target)] if own.position.ndim == 1 else [*zip(own.each(), target.each(), strict=True)]

    def _each(self, name: str, size: int, own: Placed, target: Placed) -> Array:
        function = getattr(self.own, name)
        values = [self._checked(name, self._call(name, function, *pair), size) for pair in self._pairs(own, target)]
        return np.array(values).reshape(*own.position.shape[:-1], size)

    def _call(self, name: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Return the result of a user's function. Raises CoopenvError: it raises something."""
        try:
            return function(*arguments, **options)
        except Exception as error:  # of any user's code
            raise CoopenvError(f"sensor '{self.reference}': {name}: {error_text(error)}") from error

    def _checked(self, name: str, value: Any, *shape: int) -> Array:
        """Return an array of a shape. Raises CoopenvError: it has another one, or is no array of numbers."""
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            array = np.empty(0)
        array = array.reshape(1) if array.shape == () and shape == (1,) else array
        if array.shape != shape:
            raise CoopenvError(f"sensor '{self.reference}': {name}: expected shape {shape}, got {shown(value)}")
        return array

    def _try(self) -> None:
        """Find the shapes at a few random places, and compare a given Jacobian with differences."""
        rng = np.random.default_rng(0)
        places = [placed_at_random(rng) for _ in range(2 * TRIALS)]
        for own, target in zip(places[::2], places[1::2], strict=True):
            value = np.asarray(self._call("predict", self.own.predict, own, target), dtype=np.float64)
            self.size = max(1, value.size)
            if value.ndim > 1 or self.size > MOST_ROWS:
                raise CoopenvError(f"sensor '{self.reference}': predict: expected 1 to 6 numbers, got {shown(value)}")
            value = value.reshape(self.size)
            if not np.isfinite(value).all():
                raise CoopenvError(f"sensor '{self.reference}': predict: not finite: {shown(value.tolist())}")
            change = self.own.residual(value, value) if hasattr(self.own, "residual") else value
            self.rows = max(1, np.size(change))
            self.noise = self._noise()
            self.needs = self._needs(own, target) if self.has_target else ()
            if self.rows != self.size and not hasattr(self.own, "sample"):
                sizes = f"predict returns {self.size} numbers and residual {self.rows}"
                raise CoopenvError(f"sensor '{self.reference}': sample: missing; {sizes}")
            self.units = tuple(getattr(self.own, "units", ("1",) * self.rows))
            if hasattr(self.own, "jacobian"):
                self._compare(own, target)

    def _needs(self, own: Placed, target: Placed) -> tuple[str, ...]:
        """Return what is needed of a target beside its position: without it there is no prediction."""
        found = []
        for name in ("rotation", "velocity"):
            without = replace(target, **{name: np.full_like(getattr(target, name), np.nan)})
            try:
                known = bool(np.isfinite(np.asarray(self.own.predict(own, without), dtype=np.float64)).all())
            except Exception:  # of any user's code
                known = False
            found += [] if known else [name]
        return tuple(found)

    def _noise(self) -> tuple[float, ...]:
        given = np.atleast_1d(np.asarray(getattr(self.own, "noise", np.nan), dtype=float))
        noise = np.broadcast_to(given, self.rows) if given.size in (1, self.rows) else np.full(1, np.nan)
        if not (noise > 0.0).all():
            expected = f"one positive number, or {self.rows} of them"
            raise CoopenvError(f"sensor '{self.reference}': noise: expected {expected}, got {shown(given.tolist())}")
        return tuple(noise.tolist())

    def _compare(self, own: Placed, target: Placed) -> None:
        names = ("the sensor", "the target")
        for name, given, right in zip(names, self.jacobian(own, target), self.differences(own, target), strict=True):
            off = float(np.abs(given - right).max())
            if not off <= AGREEMENT * max(1.0, float(np.abs(right).max())):
                row, column = np.unravel_index(np.argmax(np.abs(given - right)), right.shape)
                raise CoopenvError(
                    f"sensor '{self.reference}': jacobian by {name}: entry [{row}, {column}] is "
                    f"{given[row, column]:.6g}, by differences {right[row, column]:.6g}"
                )


def placed_at_random(rng: np.random.Generator) -> Placed:
    """Return a place some metres from the origin, in motion."""
    axes = exponential(rng.normal(size=3))
    return Placed(rng.uniform(-10.0, 10.0, 3), axes, rng.normal(size=3), 0.1 * rng.normal(size=3))
