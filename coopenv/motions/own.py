"""The contract of a user's own drive: one class in NumPy, which moves one vehicle on the host.

    class Mine:
        columns = [("speed", "m/s", 0.0, 1.5), ("steering", "rad", -0.6, 0.6)]

        def __init__(self, dynamics): ...          # the vehicle's [dynamics]
        def start(self, pose): ...                 # x (m), y (m), heading (rad), speed (m/s) -> state (n,)
        def step(self, state, command, dt): ...    # state (n,), a value per column, s -> state (n,)
        def turn(self, state): ...                 # optional: present value of the second column
        def bodies(self, state): ...               # optional: boxes (K, 5) besides the vehicle's own body

The first four entries of a state are pose and speed, further ones are the drive's own. What the class returns is
checked. docs/contributing/vehicle.md has an example.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from coopenv.base.errors import UserCodeError, shown
from coopenv.base.installation import blamed, load_reference

if TYPE_CHECKING:
    import numpy as np

POSE = ("x", "y", "heading", "speed")
"""First entries of a state: m, m, rad, m/s; map frame."""
BOX = 5
"""Numbers of a box: centre (m, m), heading (rad), length and width (m); map frame."""


@dataclass(frozen=True)
class CommandColumn:
    """One column of a command: what an entry of an action spans as it goes from -1 to 1."""

    name: str  # of what is commanded
    unit: str  # of low and high
    low: float  # value of -1
    high: float  # value of 1
    limit: str = ""  # key of `[dynamics]` that sets `high`; empty: the class of the user's own drive sets it


class OwnDrive:
    """The drive of one vehicle, made from the user's class; every error is one line with the place of the class."""

    def __init__(self, limits: Any) -> None:
        """Make it from the vehicle's `[dynamics]`.

        Raises:
            CoopenvError: the class cannot be loaded, fails, or lacks columns, `start` or `step`.
        """
        self.where = f"dynamics.model: {limits.model}"
        kind = load_reference(limits.model)
        with blamed(self.where, UserCodeError):
            self._made = kind(limits)
        for name in ("start", "step"):
            if not callable(getattr(self._made, name, None)):
                raise UserCodeError(f"{self.where}: has no method {name}(), see docs/contributing/vehicle.md")
        self.columns = self._checked_columns(getattr(self._made, "columns", None))
        """Two or three; the second and the third are symmetric."""

    def _checked_columns(self, rows: Any) -> tuple[CommandColumn, ...]:
        where = f"{self.where}: columns"
        if not isinstance(rows, list | tuple) or len(rows) not in (2, 3):
            raise UserCodeError(f"{where}: expected two or three rows (name, unit, low, high), got {shown(rows)}")
        found: list[CommandColumn] = []
        for row in rows:
            try:
                name, unit, low, high = row
                column = CommandColumn(str(name), str(unit), float(low), float(high))
                valid = column.name.isidentifier() and -1e9 <= column.low < column.high <= 1e9
            except (TypeError, ValueError):
                valid = False
            if not valid or (found and column.low != -column.high):
                span = "low = -high" if found else "low < high"
                raise UserCodeError(f"{where}: expected (name, unit, low, high) with {span}, got {shown(row)}")
            found.append(column)
        return tuple(found)

    def start(self, pose: np.ndarray) -> np.ndarray:
        """Return the state (n,) at a pose and speed (4,). Raises CoopenvError: the class fails."""
        return self._numbers("start", None, self._made.start, pose)

    def step(self, state: np.ndarray, command: np.ndarray, dt: float) -> np.ndarray:
        """Return the state (n,) after dt (s) under a value per column. Raises CoopenvError: the class fails."""
        return self._numbers("step", state.shape, partial(self._made.step, dt=dt), state, command)

    def turn(self, state: np.ndarray, commanded: float) -> float:
        """Return the present value of the second column: by the class, or else as commanded."""
        if not hasattr(self._made, "turn"):
            return commanded
        return float(self._numbers("turn", (), self._made.turn, state))

    def bodies(self, state: np.ndarray) -> np.ndarray:
        """Return the boxes (K, 5) besides the vehicle's own body: always as many, none by default."""
        import numpy as np

        if not hasattr(self._made, "bodies"):
            return np.zeros((0, BOX))
        boxes = self._numbers("bodies", None, self._made.bodies, state)
        if boxes.ndim != 2 or boxes.shape[1] != BOX:
            raise UserCodeError(f"{self.where}: bodies: expected shape (K, {BOX}), got {boxes.shape}")
        return boxes

    def _numbers(self, method: str, shape: tuple[int, ...] | None, call: Any, *given: np.ndarray) -> np.ndarray:
        import numpy as np

        where = f"{self.where}: {method}"
        with blamed(where, UserCodeError):
            found = np.array(call(*(np.array(part) for part in given)), dtype=float)
        if method == "start" and (found.ndim != 1 or len(found) < len(POSE)):
            raise UserCodeError(f"{where}: expected a state (n,) that begins with {', '.join(POSE)}, got {found.shape}")
        if shape is not None and found.shape != shape:
            raise UserCodeError(f"{where}: expected shape {shape}, got {found.shape}")
        if not np.isfinite(found).all():
            raise UserCodeError(f"{where}: expected finite numbers, got {shown(found.tolist())}")
        return found
