"""Episodes that are watched while they run, as frames of the live view."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError, listed, suggest
from coopenv.episode import Episode, Frame, Origin
from coopenv.evaluation.episodes import play
from coopenv.observers.registry import available_names
from coopenv.policies import Policy
from coopenv.runs.recorder import source_of
from coopenv.runs.scenes import MAX_FPS
from coopenv.scenario import Scenario
from coopenv.sources.base import Backend
from coopenv.viz.stage import vehicle_mark
from coopenv.viz.web_panel import Abilities


def vehicle_index(scenario: Scenario, name: str | None) -> int:
    """Return the index of a vehicle by its name or by f1, f2, ...; of the first without a name.

    Raises:
        CoopenvError: there is no such vehicle.
    """
    known = {own: i for i, own in enumerate(scenario.vehicle_names)}
    found = known | {vehicle_mark(i): i for i in known.values()}
    if name is not None and name not in found:
        raise CoopenvError(f"--vehicle {name}: no such vehicle{suggest(name, known)}; known: {listed([*known])}")
    return 0 if name is None else found[name]


class Reel:
    """Frames, one after the other; past frames are kept. The frames of a kept scene cannot be changed."""

    def __init__(
        self, scenario: Scenario, source: Origin, length: float, coming: Iterable[Frame], abilities: Abilities
    ) -> None:
        """Begin with none; `length` is the episode's, s, and `abilities` are the possible actions."""
        self.scenario, self.source, self.length, self._coming = scenario, source, length, iter(coming)
        self.frames, self.abilities = list[Frame](), abilities

    @classmethod
    def of(cls, record: Episode) -> "Reel":
        """Return the frames of a scene that a run has kept."""
        return cls(record.scenario, record.source, record.length, map(record.frame, range(len(record))), Abilities())

    def more(self) -> bool:
        """Append the next frame; return False where there is none."""
        frame = next(self._coming, None)
        if frame is not None:
            self.frames.append(frame)
        return frame is not None

    def change(self, observer: str | None = None, fault: Mapping[str, Any] | None = None) -> None:
        """Go through the episode again from its start to the present.

        Args:
            observer: name of the one that estimates now (None: the same).
            fault: changes of the scenario's dotted keys in place of those of an earlier fault (None: the same).

        Raises:
            CoopenvError: that is not valid, or nothing can be changed here; all is as before then.
        """
        raise CoopenvError("nothing can be changed here")

    def close(self) -> None:
        """Let go of everything."""


class EngineReel(Reel):
    """The frames of an episode that runs while it is watched."""

    def __init__(
        self,
        open_backend: Callable[[Mapping[str, Any]], Backend],
        name: str,
        seed: int,
        driver: Callable[[Scenario], tuple[Policy | None, str]],
    ) -> None:
        """Open the backend and build everything.

        Args:
            open_backend: returns the backend under changes of the scenario's dotted keys.
            name: of what is shown.
            seed: of the episode.
            driver: returns the policy in a scenario, and its name.

        Raises:
            CoopenvError: something of it cannot be.
        """
        self._open, self._name, self._seed, self._driver = open_backend, name, seed, driver
        self._observer: Mapping[str, Any] = {}
        self._fault: Mapping[str, Any] = {}
        self._begin()

    def _begin(self) -> None:
        """Build everything; no frame is there yet."""
        backend = self._open({**self._observer, **self._fault})
        scenario, able = backend.scenario, backend.capabilities
        policy, driver = (None, "") if able.recorded else self._driver(scenario)
        self.engine = engine = Engine(scenario, backend=backend)
        engine.load()
        ticks = play(engine, [self._seed], scenario.horizon_ticks, policy, to_the_end=False)
        stride = max(1, round(scenario.rates.camera / MAX_FPS))
        source = source_of(engine, self._name, None if able.real_time else self._seed, driver)
        abilities = Abilities(pace=False)
        if not able.real_time:
            running = scenario.observer.name
            others = (name for name in available_names() if name != running)
            abilities = Abilities(observers=(running, *others), faults=() if able.recorded else tuple(FAULTS))
        frames = (Frame.of(engine) for tick in ticks if tick % stride == 0)
        super().__init__(scenario, source, scenario.horizon, frames, abilities)

    def change(self, observer: str | None = None, fault: Mapping[str, Any] | None = None) -> None:
        """Build everything anew, and run up to where it was."""
        before = dict(vars(self))
        self._observer = self._observer if observer is None else {"observer.name": observer}
        self._fault = self._fault if fault is None else fault
        try:
            self._begin()
            while len(self.frames) < len(before["frames"]) and self.more():
                pass
        except BaseException:
            failed = self.engine
            vars(self).update(before)
            if failed is not self.engine:
                failed.close()
            raise
        before["engine"].close()

    def close(self) -> None:
        """Close the engine."""
        self.engine.close()


FAULTS: dict[str, Callable[[float, int], dict[str, Any]]] = {
    "half of the messages corrupted from now on": lambda time, vehicle: {
        "faults.corruption.probability": 0.5,
        "faults.corruption.start": time,
    },
    "picked vehicle lies by 5 m from now on": lambda time, vehicle: {
        f"vehicles.{vehicle}.faults": {"lie": {"kind": "jump", "start": time}}
    },
    "picked vehicle's computer restarts now": lambda time, vehicle: {
        f"vehicles.{vehicle}.faults": {"restart": {"chance": 1.0, "time": time}}
    },
    "half of the messages lost, whole episode": lambda time, vehicle: {"v2x.loss": 0.5},
    "half of the detections missed, whole episode": lambda time, vehicle: {"camera.miss_probability": 0.5},
}
"""Changes of the scenario by the name of a fault, for a time in s and a vehicle."""
