"""The arrays of a recording, filled message by message; a tick that comes twice, or never, is refused by its number."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from coopenv.backends.mcap.messages import CONTENTS, EXACT, LANDMARKS, PAN, topic
from coopenv.base.errors import check_memory
from coopenv.observers.recording import KINDS, SHAPES, Truth


class TickArrays:
    """K ticks of N vehicles and T targets, of which the first L are landmarks; `pan` says whether cameras turn."""

    def __init__(self, ticks: int, vehicles: Sequence[str], targets: int, landmarks: int, pan: bool) -> None:
        """Allocate the arrays. Raises CoopenvError: they would not fit into memory."""
        sizes = {"K": ticks, "N": len(vehicles), "T": targets, "L": landmarks}
        shapes = {name: [int(sizes.get(str(n), n)) for n in shape] for name, shape in SHAPES.items() if shape[0] == "K"}
        shapes |= {"pan": [ticks, len(vehicles)]} if pan else {}
        exact = EXACT | PAN if pan else EXACT
        needed = 8 * sum(math.prod(shape) for shape in shapes.values())
        check_memory(needed, f"a recording of {ticks} ticks, {len(vehicles)} vehicles and {targets} targets")
        self._shape_of_landmarks = shapes.pop("landmarks")[1:]
        shapes["due"].append(len(vehicles))
        dtypes: dict[str, Any] = {"b": np.bool_, "i": np.int64}
        # zeros take no memory before they are written to
        self._arrays = {name: np.zeros(n, dtypes.get(KINDS.get(name, ""), np.float64)) for name, n in shapes.items()}
        self._ticks, self._targets = ticks, targets
        self._landmarks: dict[int, np.ndarray] = {}
        self._places = {topic(name, field): (field, i) for i, name in enumerate(vehicles) for field in exact}
        self._columns = {
            name: [(part, self._arrays[array][:, i]) for part, array in CONTENTS[field].items()]
            for name, (field, i) in self._places.items()
        }
        self._seen = {name: np.zeros(ticks, dtype=bool) for name in self._places}

    def put(self, name: str, k: int, message: Any) -> None:
        """Take the message of a topic at a tick; a ValueError says why it does not fit."""
        if k >= self._ticks:
            raise ValueError(f"the recording ends at tick {self._ticks - 1}")
        if self._seen[name][k] if name in self._seen else k in self._landmarks:
            raise ValueError("is there twice")
        if name == LANDMARKS:
            points = [[q.position.x, q.position.y, q.position.z] for q in message.poses]
            self._landmarks[k] = np.array(points, np.float64).reshape(self._shape_of_landmarks)
            return
        field, i = self._places[name]
        self._seen[name][k] = True
        if field == "bearings":
            self._put_bearings(k, i, message)
        for part, column in self._columns[name]:
            column[k] = getattr(message, part).reshape(column.shape[1:])

    def _put_bearings(self, k: int, i: int, m: Any) -> None:
        targets, count = m.targets, len(m.targets)
        if len(np.unique(targets)) != count or (targets >= self._targets).any():
            raise ValueError(f"targets are not different ones of {self._targets}")
        self._arrays["due"][k, i] = m.due
        self._arrays["bearings"][k, i] = np.nan
        self._arrays["bearings"][k, i, targets] = m.vectors.reshape(count, 3)
        self._arrays["visible"][k, i, targets] = m.visible.reshape(count).view(np.uint8) != 0

    def complete(self) -> dict[str, Any]:
        """Return the arrays as arguments of a `Recording`; a ValueError names what is missing or contradicts itself."""
        for name, seen in {LANDMARKS: np.array([0 in self._landmarks]), **self._seen}.items():
            if not seen.any():
                raise ValueError(f"topic '{name}' is missing")
            if not seen.all():
                raise ValueError(f"topic '{name}': tick {int(np.argmin(seen))} is missing")
        arrays, changes = dict(self._arrays), sorted(self._landmarks)
        due = arrays.pop("due")
        for k in np.flatnonzero((due != due[:, :1]).any(axis=1)).tolist():
            raise ValueError(f"at tick {k} a correction is due for some vehicles only")
        arrays["due"] = due[:, 0].copy()
        lengths = np.diff([*changes, self._ticks])
        arrays["landmarks"] = np.repeat([self._landmarks[k] for k in changes], lengths, axis=0)
        truth = Truth(arrays.pop("truth.rotation"), arrays.pop("truth.position"))
        for values in arrays.values():
            values.setflags(write=False)  # observers get views
        return {**arrays, "truth": truth}
