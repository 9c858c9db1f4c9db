"""The sensors beside the camera of a batch of worlds: launches of their kernels, and users' kinds on the host."""

import re
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError, UserCodeError
from coopenv.measurements.kinds import MOST_ROWS, Landmarks, Placed
from coopenv.measurements.sensor import Sensor
from coopenv.scenario.sensors import SensorSection
from coopenv.world.embedded import Nothing
from coopenv.world.launch import Call, PerWorld
from coopenv.world.model import Precision
from coopenv.world.sensors import drawn_struct, sensor_kernel
from coopenv.world.state import allocate, state_sizes

Indices = NDArray[np.int64]


class SensorStage:
    """The stage of all sensors beside the camera."""

    def __init__(
        self, sections: Sequence[SensorSection], model: Any, state: Any, mask: Any, p: Precision, names: Sequence[str]
    ) -> None:
        """Find the kernels.

        Args:
            sections: of all sensors of the scenario; empty if a source gives their measurements.
            model: of the scenario.
            state: of the worlds.
            mask: (W,) as `World.mask`.
            p: precision of both.
            names: of the targets.

        Raises:
            CoopenvError: a user's kind on another device than the CPU.
        """
        self._sections, self._model, self._state, self._mask, self._names = sections, model, state, mask, names
        self._kinds = [section.made for section in sections]
        self.there = len(sections) > 0
        """True if there is a sensor."""
        self.own = [d for d, kind in enumerate(self._kinds) if kind.in_warp is None]
        """Sensors whose values the host computes."""
        device = state.tick.device
        for d in self.own if not device.is_cpu else ():
            name, kind = sections[d].label, sections[d].kind
            raise CoopenvError(f"sensors.{name}: '{kind}' measures on the host; use device='cpu'")
        if self.own:
            self._drawn = allocate(drawn_struct(p), state_sizes(model, len(state.tick)), str(device))
        self._kernels = [
            sensor_kernel("own" if kind.in_warp is None else re.sub(r"\W", "_", section.kind), kind.in_warp, p)
            for section, kind in zip(sections, self._kinds, strict=True)
        ]

    def calls(self, begins: bool = False) -> list[Call]:
        """Return the launches of a tick, or of tick 0 in the worlds of the mask."""
        state, mask = PerWorld(self._state), PerWorld(self._mask)
        drawn = [PerWorld(self._drawn) if d in self.own else Nothing() for d in range(len(self._kinds))]
        return [
            (kernel, [self._model, state, drawn[d], mask, d, int(begins)]) for d, kernel in enumerate(self._kernels)
        ]

    def compute(self, begins: bool = False) -> None:
        """Write the values of users' kinds after the launches of a tick, or of tick 0 in the worlds of the mask.

        Raises:
            CoopenvError: a user's class raises something, or returns what it must not.
        """
        if not self.own:
            return
        tick, made = self._state.tick.numpy(), self._drawn.measured.numpy().copy()
        self._drawn.measured.zero_()
        now = np.where(begins, 0, tick + 1)
        for w in np.flatnonzero(made.any(axis=(1, 2, 3))).tolist():
            for d in self.own:
                i, target = np.nonzero(made[w, :, d])
                if len(i):
                    self._measure(w, d, i, target, int(now[w]))

    def _measure(self, w: int, d: int, i: Indices, target: Indices, tick: int) -> None:
        """Write the values of one sensor of vehicles i (m,) towards targets (m,) in a world."""
        kind = self._kinds[d]
        found = kind.sensed(*self._places(w, d, i, target))
        i, target = i[found], target[found]
        if not len(i):
            return
        noise = self._drawn.noise.numpy()[w, i, d, target, : kind.rows].astype(float)
        values = kind.sample(kind.predict(*self._places(w, d, i, target)), noise)
        if not np.isfinite(values).all():
            raise UserCodeError(f"sensor '{self._sensors[d].reference}': predict: not finite")
        self._state.reading.numpy()[w, i, d, target] = np.pad(values, [(0, 0), (0, MOST_ROWS - kind.size)])
        self._state.reading_tick.numpy()[w, i, d, target] = tick

    def _places(self, w: int, d: int, i: Indices, target: Indices) -> tuple[Placed, Placed]:
        """Return where a sensor of vehicles i (m,) is, and targets (m,), in a world."""
        L, markers = self._model.landmarks, np.array(self._model.scene.marker.numpy(), float)
        R, position, velocity, turning = (np.array(getattr(self._state, name).numpy()[w], float) for name in POSES)
        points = position + (R @ markers[..., None])[..., 0]
        marks = Landmarks(zip(self._names[:L], points[:L], strict=True))
        at = L + i
        own = self._sensors[d].placed(R[at], position[at], velocity[at], turning[at], marks)
        if not self._kinds[d].has_target:
            return own, Placed.at(np.zeros((len(i), 3)))
        moving = velocity[target] + np.cross(turning[target], markers[target])
        return own, Placed(points[target], R[target], (R[target] @ moving[..., None])[..., 0], turning[target])

    @cached_property
    def _sensors(self) -> dict[int, Sensor]:
        """Users' sensors, for their places on bodies."""
        nothing = np.empty(0)
        return {
            d: Sensor(s.label, s.kind, nothing, nothing.astype(int), np.array(s.position), s.mounting, s.arguments)
            for d, s in enumerate(self._sections)
            if d in self.own
        }


POSES = ("rotation", "position", "velocity", "angular_velocity")
"""Fields of the state, in the order of the arguments of `Sensor.placed`."""
