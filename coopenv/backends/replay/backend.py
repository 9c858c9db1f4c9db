"""The replay backend: recorded ticks fill the state, the same estimators and reports run on it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from coopenv.backends.replay.device_recording import upload
from coopenv.backends.replay.kernels import redeliver_kernel, replay_kernel, resense_kernel, rewind_kernel
from coopenv.backends.replay.scenario import scenario_of
from coopenv.observers.recording import Briefing, Recording, Sensed
from coopenv.observers.recording_checks import check_recording
from coopenv.scenario import Scenario
from coopenv.world.embedded import ROBUST, Kernels
from coopenv.world.launch import PerWorld
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
        return ReplayWorld(self.recording, self.scenario, worlds, dtype, device, threads)

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

    def __init__(
        self,
        recording: Recording,
        scenario: Scenario,
        worlds: int = 1,
        dtype: str = "float32",
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        """Build the arrays; arguments and errors as for `World`."""
        self._recording = recording
        super().__init__(scenario, worlds, dtype, device, threads)
        self._record = upload(recording, scenario.rates.odometry, self.precision, self.device)

    @property
    def estimates(self) -> bool:
        """Whether the observer is embedded; `robust` has no embedded form for robots on a plane."""
        planar = any(setup.planar for setup in self._recording.setups)
        return super().estimates and not (planar and self.scenario.observer.name == ROBUST)

    def _start_covariance(self) -> np.ndarray:
        return self._recording.start_covariance

    @cached_property
    def _kernels(self) -> Kernels:
        if self.memory is None:
            return Kernels(replay_kernel, rewind_kernel)
        from coopenv.backends.replay.robust_kernels import replay_robust_kernel, rewind_robust_kernel

        return Kernels(replay_robust_kernel, rewind_robust_kernel)

    def _build_model(self) -> Any:
        model = super()._build_model()
        order = np.array(self._recording.order, dtype=np.int32)
        model.order = wp.array(order, dtype=wp.int32, device=self.device)
        model.rank = wp.array(np.argsort(order).astype(np.int32), dtype=wp.int32, device=self.device)
        model.radio.slots = max(self._recording.flight, 1) + 1
        return model

    def restart(self) -> None:
        """Go back to the recording's start in the worlds of `self.mask`."""
        self.launch("restart", self._kernels.reset, [self.model, *self._changing(), self._record, PerWorld(self.mask)])

    def advance(self, ticks: int) -> None:
        """Run recorded ticks with the embedded observer."""
        moving = [*self._changing(), self._record, PerWorld(self.actions), PerWorld(self.mask), ticks]
        self.launch(("advance", ticks), self._kernels.advance, [self.model, *moving])

    def sense(self, active: Any) -> None:
        """Recall the next tick."""
        self.launch("sense", resense_kernel, [*self._recorded(), PerWorld(active)])

    def deliver(self, active: Any, vehicle: int) -> None:
        """Let a vehicle receive what arrived at this tick."""
        self.launch(("deliver", vehicle), redeliver_kernel, [*self._recorded(), PerWorld(active), vehicle])

    def _recorded(self) -> list[Any]:
        return [self.model, PerWorld(self.state), self._record]
