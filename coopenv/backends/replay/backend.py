"""The replay backend: recorded ticks fill the state, the same estimators and reports run on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from coopenv.backends.replay.device_recording import upload
from coopenv.backends.replay.kernels import RECORDED
from coopenv.backends.replay.scenario import scenario_of
from coopenv.observers.recording import Briefing, Recording, Sensed
from coopenv.observers.recording_checks import check_recording
from coopenv.observers.registry import find_embedded
from coopenv.scenario import Scenario
from coopenv.world.embedded import HOST
from coopenv.world.world import World


class Replay:
    """A recording as a backend. Actions change nothing; every episode is the recording again."""

    def __init__(self, recording: Recording, name: str, overrides: Mapping[str, Any] | None = None) -> None:
        """Find the recording's scenario; arguments and errors as for `check_recording` and `scenario_of`."""
        check_recording(recording, name)
        self.recording = recording
        self.scenario = scenario_of(recording, name, overrides or {})

    def world(self, worlds: int, dtype: str, device: str, threads: int | None) -> World:
        """Return the world that goes through the recording."""
        planar = any(setup.planar for setup in self.recording.setups)
        observer = find_embedded(self.scenario.observer.name, planar) or HOST
        covariance = self.recording.start_covariance
        return ReplayWorld(self.recording, self.scenario, worlds, dtype, device, threads, observer, covariance)

    def senses(self, world: World) -> RecordedSenses:
        """Return the recorded ticks."""
        return RecordedSenses(self.recording)


class RecordedSenses:
    """Plug-in observers read the record itself, in float64 whatever the world's precision."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording

    @property
    def briefing(self) -> Briefing:
        """What the observers are told before the first tick."""
        return self._recording.briefing

    def read(self, world: int, k: int) -> Sensed:
        """Return what was sensed at tick k, the same in every world."""
        return self._recording.at(k)


class ReplayWorld(World):
    """A world whose truth, measurements and deliveries are recorded."""

    source = RECORDED

    def __init__(self, recording: Recording, scenario: Scenario, *arguments: Any) -> None:
        """Build the arrays; further arguments and errors as for `World`."""
        self._recording = recording
        super().__init__(scenario, *arguments)

    def _build_model(self) -> Any:
        model = super()._build_model()
        order = np.array(self._recording.order, dtype=np.int32)
        model.order = wp.array(order, dtype=wp.int32, device=self.device)
        model.rank = wp.array(np.argsort(order).astype(np.int32), dtype=wp.int32, device=self.device)
        model.radio.slots = max(self._recording.flight, 1) + 1
        return model

    def _build_record(self) -> Any:
        return upload(self._recording, self.scenario.rates.odometry, self.precision, self.device)
