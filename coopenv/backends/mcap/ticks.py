"""The arrays of a recording, filled message by message; a tick that comes twice, or never, is refused by its number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from coopenv.backends.mcap.messages import EXACT, LANDMARKS, topic
from coopenv.errors import check_memory
from coopenv.observers.recording import Truth

BYTES_PER_VEHICLE = 8 * (9 + 3 + 3 + 3 + 9 + 3) + len(EXACT)
BYTES_PER_TARGET = 8 * 3 + 1


class TickArrays:
    """K ticks of N vehicles and T targets, of which the first L are landmarks."""

    def __init__(self, ticks: int, vehicles: Sequence[str], targets: int, landmarks: int) -> None:
        """Allocate the arrays.

        Raises:
            CoopenvError: they would not fit into memory.
        """
        K, N, T, L = self._sizes = ticks, len(vehicles), targets, landmarks
        size = K * (N * (BYTES_PER_VEHICLE + T * BYTES_PER_TARGET + N * 8) + L * 24)
        check_memory(size, f"a recording of {K} ticks, {N} vehicles and {T} targets")
        self.arrays = {  # zeros take no memory before they are written to
            "rotation": np.zeros((K, N, 3, 3)),
            "translation": np.zeros((K, N, 3)),
            "velocity": np.zeros((K, N, 3)),
            "angular_velocity": np.zeros((K, N, 3)),
            "bearings": np.zeros((K, N, T, 3)),
            "visible": np.zeros((K, N, T), dtype=bool),
            "inbox_tick": np.zeros((K, N, N), dtype=np.int64),
        }
        self._due = np.zeros((K, N), dtype=bool)
        self._truth = Truth(np.zeros((K, N, 3, 3)), np.zeros((K, N, 3)))
        self._landmarks: dict[int, np.ndarray] = {}
        self._places = {topic(name, field): (field, i) for i, name in enumerate(vehicles) for field in EXACT}
        self._seen = {name: np.zeros(K, dtype=bool) for name in self._places}

    def put(self, name: str, k: int, message: Any) -> None:
        """Take the message of a topic at a tick.

        Raises:
            ValueError: there is no such tick, it has been there, or the message has the wrong size.
        """
        K, _, _, L = self._sizes
        if k >= K:
            raise ValueError(f"the recording ends at tick {K - 1}")
        if self._seen[name][k] if name in self._seen else k in self._landmarks:
            raise ValueError("is there twice")
        if name == LANDMARKS:
            points = [[q.position.x, q.position.y, q.position.z] for q in message.poses]
            self._landmarks[k] = np.array(points, np.float64).reshape(L, 3)
            return
        field, i = self._places[name]
        self._seen[name][k] = True
        getattr(self, f"_put_{field}")(k, i, message)

    def _put_increment(self, k: int, i: int, m: Any) -> None:
        self.arrays["rotation"][k, i] = m.rotation.reshape(3, 3)
        for name in ("translation", "velocity", "angular_velocity"):
            self.arrays[name][k, i] = getattr(m, name)

    def _put_bearings(self, k: int, i: int, m: Any) -> None:
        targets = m.targets
        if len(np.unique(targets)) != len(targets) or (targets >= self._sizes[2]).any():
            raise ValueError(f"targets are not different ones of {self._sizes[2]}")
        self._due[k, i] = m.due
        self.arrays["bearings"][k, i] = np.nan
        self.arrays["bearings"][k, i, targets] = m.vectors.reshape(len(targets), 3)
        self.arrays["visible"][k, i, targets] = m.visible.reshape(len(targets)).view(np.uint8) != 0

    def _put_v2x(self, k: int, i: int, m: Any) -> None:
        self.arrays["inbox_tick"][k, i] = m.tick_sent.reshape(self._sizes[1])

    def _put_truth_exact(self, k: int, i: int, m: Any) -> None:
        self._truth.rotation[k, i] = m.rotation.reshape(3, 3)
        self._truth.position[k, i] = m.position

    def complete(self) -> dict[str, Any]:
        """Return the arrays as arguments of a `Recording`.

        Raises:
            ValueError: a topic or tick is missing, or vehicles do not agree on when corrections are due.
        """
        for name, seen in {LANDMARKS: np.array([0 in self._landmarks]), **self._seen}.items():
            if not seen.any():
                raise ValueError(f"topic '{name}' is missing")
            if not seen.all():
                raise ValueError(f"topic '{name}': tick {int(np.argmin(seen))} is missing")
        if (self._due != self._due[:, :1]).any():
            k = int(np.argwhere(self._due != self._due[:, :1])[0, 0])
            raise ValueError(f"at tick {k} a correction is due for some vehicles only")
        changes = sorted(self._landmarks)
        lengths = np.diff([*changes, self._sizes[0]])
        landmarks = np.repeat([self._landmarks[k] for k in changes], lengths, axis=0)
        for values in (*self.arrays.values(), landmarks):
            values.setflags(write=False)  # observers get views
        return {**self.arrays, "landmarks": landmarks, "due": self._due[:, 0].copy(), "truth": self._truth}
