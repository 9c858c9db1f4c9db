"""V2X messages: a bead that flies from the sender to the receiver, at most one on a link at a time."""

from typing import Any

import numpy as np

from coopenv.viz.scene import Frame, Stage
from coopenv.viz.web import shapes
from coopenv.viz.web.copies import Batch, fine, placed
from coopenv.viz.web.ground import ROOT

FLIGHT, PAUSE = 0.5, 1.0
"""s of the scene's time: how long a bead flies, and the least time between two of a link."""
_SIZE = 0.006  # of the scene's side


class Pulses:
    """Beads on the links between vehicles."""

    def __init__(self, scene: Any, stage: Stage, colours: np.ndarray) -> None:
        """Begin with none."""
        n = stage.vehicles
        self._stage = stage
        self._receiver, self._sender = (part.ravel() for part in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        self._batch = Batch(scene, f"{ROOT}/messages", shapes.sphere(5), colours[self._sender])
        self._began = np.full(n * n, -np.inf)
        self._last = np.full(n * n, -1)
        self._time = -np.inf
        self._step = 2.0 ** np.floor(np.log2(stage.side * 1e-4))

    def place(self, frame: Frame, time: float, shown: bool) -> None:
        """Let those fly whose message arrived since the last frame, and the others on."""
        arrived = frame.inbox_tick.ravel()
        if time < self._time:
            self._began[:], self._last[:] = -np.inf, arrived
        new = (arrived > self._last) & (time >= self._began + PAUSE)
        self._began[new] = time
        self._last, self._time = arrived.copy(), time
        share = (time - self._began) / FLIGHT
        eye = self._stage.eyes(frame)
        start, end = eye[self._sender], eye[self._receiver]
        flying = (share >= 0.0) & (share <= 1.0) & (self._sender != self._receiver)
        at = start + np.where(flying, share, 0.0)[:, None] * (end - start)
        size = np.where(flying, _SIZE * self._stage.side, np.nan)[:, None].repeat(3, axis=1)
        self._batch.put(placed(None, fine(at, self._step), size), shown)
