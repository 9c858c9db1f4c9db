"""A user's own kind of measurement: one class of plain NumPy that computes one measurement at a time."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import UserCodeError, error_text, shown
from coopenv.base.installation import load_reference
from coopenv.estimation.poses import Array
from coopenv.measurements.kinds import MOST_ROWS, Kind, Landmarks, Placed, exponential

AGREEMENT = 1e-4  # of a derivative with differences, relative to its largest entry
PLACES, TRIALS = 30, 3  # drawn before a class is used, and those at which it is tried


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
            raise UserCodeError(f"sensor '{reference}': expected a class with predict(own, target), got {shown(made)}")
        self.own = self._call("its start", made, **options)
        self.has_target = bool(getattr(self.own, "has_target", True))
        self.towards = self._names("towards", Kind.towards if self.has_target else ("map",))
        for name in ("in_warp", "drawn", "under_sky"):
            setattr(self, name, getattr(self.own, name, getattr(Kind, name)))
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
        return np.not_equal(self._each("sensed", 1, own, target)[..., 0], 0.0)

    def _pairs(self, own: Placed, target: Placed) -> list[tuple[Placed, Placed]]:
        return [(own, target)] if own.position.ndim == 1 else [*zip(own.each(), target.each(), strict=True)]

    def _each(self, name: str, size: int, own: Placed, target: Placed) -> Array:
        function = getattr(self.own, name)
        values = [self._checked(name, self._call(name, function, *pair), size) for pair in self._pairs(own, target)]
        return np.array(values).reshape(*own.position.shape[:-1], size)

    def _call(self, name: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Return the result of a user's function. Raises UserCodeError: it raises something."""
        try:
            return function(*arguments, **options)
        except (Exception, SystemExit) as error:  # of any user's code
            raise UserCodeError(f"sensor '{self.reference}': {name}: {error_text(error)}") from error

    def _checked(self, name: str, value: Any, *shape: int) -> Array:
        """Return an array of a shape. Raises UserCodeError: it has another one, or is no array of numbers."""
        array = as_numbers(value)
        if shape[0] == 1 and array.shape == shape[1:]:  # one row may come without its axis
            array = array.reshape(shape)
        if array.shape != shape:
            raise UserCodeError(f"sensor '{self.reference}': {name}: expected shape {shape}, got {shown(value)}")
        return array

    def _try(self) -> None:
        """Find the shapes at a few random places, and compare a given Jacobian with differences."""
        for own, target in self.trials():
            value = self._numbers("predict", self._call("predict", self.own.predict, own, target))
            self.size = len(value)
            change: Any = value
            if hasattr(self.own, "residual"):
                change = self._call("residual", self.own.residual, value, value)
            self.rows = len(self._numbers("residual", change))
            self.noise = self._noise()
            self.needs = self._needs(own, target) if self.has_target else ()
            if self.rows != self.size and not hasattr(self.own, "sample"):
                sizes = f"predict returns {self.size} numbers and residual {self.rows}"
                raise UserCodeError(f"sensor '{self.reference}': sample: missing; {sizes}")
            self.units = self._names("units", ("1",) * self.rows)
            if len(self.units) != self.rows:
                raise UserCodeError(f"sensor '{self.reference}': units: {len(self.units)} for {self.rows} rows")
            self._numbers("sample", self.sample(value, 0.1 * np.array(self.noise)))
            if hasattr(self.own, "jacobian"):
                self._compare(own, target)

    def trials(self) -> list[tuple[Placed, Placed]]:
        """Return random places at which the class measures; the first ones if there are hardly any."""
        rng = np.random.default_rng(0)
        pairs = [(placed_at_random(rng), placed_at_random(rng)) for _ in range(PLACES)]
        return ([pair for pair in pairs if self.sensed(*pair)] or pairs)[:TRIALS]

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

    def _names(self, attribute: str, usual: tuple[str, ...]) -> tuple[str, ...]:
        """Return an attribute of the class: one text, or several. Raises UserCodeError: it is something else."""
        given = getattr(self.own, attribute, usual)
        names = (given,) if isinstance(given, str) else given
        if not (isinstance(names, tuple | list) and all(isinstance(name, str) for name in names)):
            raise UserCodeError(f"sensor '{self.reference}': {attribute}: expected texts, got {shown(given)}")
        return tuple(names)

    def _numbers(self, name: str, value: Any) -> Array:
        """Return 1 to 6 finite numbers as a vector. Raises UserCodeError: it is something else."""
        array = as_numbers(value)
        if array.ndim > 1 or not 1 <= array.size <= MOST_ROWS:
            raise UserCodeError(f"sensor '{self.reference}': {name}: expected 1 to 6 numbers, got {shown(value)}")
        if not np.isfinite(array).all():
            raise UserCodeError(f"sensor '{self.reference}': {name}: not finite: {shown(value)}")
        return array.reshape(-1)

    def _noise(self) -> tuple[float, ...]:
        stated = getattr(self.own, "noise", None)
        given = np.atleast_1d(as_numbers(stated))
        noise = np.broadcast_to(given, self.rows) if given.shape in ((1,), (self.rows,)) else np.full(1, np.nan)
        if not (noise > 0.0).all():
            expected = f"one positive number, or {self.rows} of them"
            raise UserCodeError(f"sensor '{self.reference}': noise: expected {expected}, got {shown(stated)}")
        return tuple(noise.tolist())

    def _compare(self, own: Placed, target: Placed) -> None:
        names = ("the sensor", "the target")
        for name, given, right in zip(names, self.jacobian(own, target), self.differences(own, target), strict=True):
            off = float(np.abs(given - right).max())
            if not off <= AGREEMENT * max(1.0, float(np.abs(right).max())):
                row, column = np.unravel_index(np.argmax(np.abs(given - right)), right.shape)
                raise UserCodeError(
                    f"sensor '{self.reference}': jacobian by {name}: entry [{row}, {column}] is "
                    f"{given[row, column]:.6g}, by differences {right[row, column]:.6g}"
                )


def as_numbers(value: Any) -> Array:
    """Return a value as an array of real numbers; an empty one of two axes if it is none."""
    try:
        array = np.asarray(value)
        return array.astype(np.float64, casting="same_kind" if array.dtype.kind != "O" else "unsafe")
    except (TypeError, ValueError):
        return np.empty((0, 0))


class AnyLandmarks(Landmarks):
    """Landmarks of every name, at random positions, some of them from the start on."""

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__({f"landmark_{n}": rng.uniform(-10.0, 10.0, 3) for n in range(3)})
        self._rng = rng

    def __missing__(self, name: str) -> Array:
        """Return the position of one more landmark."""
        return self.setdefault(name, self._rng.uniform(-10.0, 10.0, 3))


def placed_at_random(rng: np.random.Generator) -> Placed:
    """Return a place some metres from the origin, in motion."""
    axes = exponential(rng.normal(size=3))
    twist = rng.normal(size=3), 0.1 * rng.normal(size=3)
    return Placed(rng.uniform(-10.0, 10.0, 3), axes, *twist, AnyLandmarks(np.random.default_rng(1)))
