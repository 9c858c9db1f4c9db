"""The replay backend: recorded ticks fill the state, the same estimators and reports run on it."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from coopenv.backends.base import Capabilities, Episode, SensingWorld, TickGenerator
from coopenv.backends.replay.kernels import RECORDED, samples_taken, upload
from coopenv.backends.replay.scenario import scenario_of
from coopenv.observers.recording import Briefing, Recording, Sensed, check_recording
from coopenv.observers.registry import find_embedded
from coopenv.scenario import Scenario
from coopenv.world.embedded import HOST


class ReplayWorld(SensingWorld):
    """A world whose truth, measurements and deliveries are recorded."""

    source = RECORDED

    def __init__(self, recording: Recording, scenario: Scenario, *arguments: Any) -> None:
        """Build the arrays; further arguments and errors as for `World`."""
        self._recording = recording
        super().__init__(scenario, *arguments)

    @cached_property
    def briefing(self) -> Briefing:
        """What observers are told before the first tick."""
        return self._recording.briefing

    def sensed(self, world: int, k: int) -> Sensed:
        """Return what was sensed at tick k, the same in every world and in float64 whatever the precision."""
        return self._recording.at(k)

    def _build_model(self) -> Any:
        model = super()._build_model()
        order = np.array(self._recording.order, dtype=np.int32)
        model.order = wp.array(order, dtype=wp.int32, device=self.device)
        model.rank = wp.array(np.argsort(order).astype(np.int32), dtype=wp.int32, device=self.device)
        model.radio.slots = max(self._recording.flight, 1) + 1 + self.scenario.replay_ticks
        return model

    def _build_record(self) -> Any:
        return upload(self._recording, self.scenario.rates.odometry, self.precision, self.device)


class Replay(TickGenerator):
    """A recording as a backend. Actions change nothing; every episode is the recording again."""

    def __init__(self, recording: Recording, name: str, overrides: Mapping[str, Any] | None = None) -> None:
        """Find the recording's scenario; arguments and errors as for `check_recording` and `scenario_of`."""
        check_recording(recording, name)
        self.recording = recording
        scenario, known = scenario_of(recording, name, overrides or {}), bool(recording.truth.known.any())
        ticks = scenario.horizon_ticks + 1
        abilities = Capabilities(truth=known, driven=False, real_time=False, ticks=ticks, batched=True, recorded=True)
        super().__init__(scenario, abilities)

    def world(self, worlds: int, dtype: str, device: str, threads: int | None) -> ReplayWorld:
        """Return worlds that go through the recording."""
        planar = any(setup.planar for setup in self.recording.setups)
        observer = find_embedded(self.scenario.observer.name, planar) or HOST
        covariance = self.recording.start_covariance
        return ReplayWorld(self.recording, self.scenario, worlds, dtype, device, threads, observer, covariance)

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> Episode:
        """Go through the recording tick by tick."""
        recording, rate = self.recording, self.scenario.rates.odometry
        taken = samples_taken(recording.t, rate)
        age = np.where(taken > 0, recording.t - (taken - 1) / rate, np.inf)
        for k in range(self.scenario.horizon_ticks + 1):
            yield replace(recording.at(k), odometry_age=np.full(len(recording.setups), age[k]))
