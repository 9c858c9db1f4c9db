"""Where the frames of the live view come from: an episode that runs, one that has been kept, or cars."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from coopenv.api.engine import Engine
from coopenv.backends.base import Backend
from coopenv.base.errors import CoopenvError, listed, suggest
from coopenv.policies import Policy
from coopenv.runs.rollouts import play
from coopenv.runs.video import MAX_FPS
from coopenv.scenario import Scenario
from coopenv.viz.scene import Frame, SceneRecord, Source
from coopenv.viz.web.panel import Abilities

Open = Callable[[Mapping[str, Any]], Backend]
"""Returns a backend under changes of the scenario's dotted keys."""
Driver = Callable[[Scenario], tuple[Policy | None, str]]
"""Returns who drives in a scenario, and its name."""


class Reel(ABC):
    """Frames, one after the other; those that have been are kept."""

    def __init__(self, scenario: Scenario, source: Source, length: float) -> None:
        """Begin with none; `length` is that of the episode, s."""
        self.scenario, self.source, self.length = scenario, source, length
        self.frames: list[Frame] = []
        self.real_time = False
        """Whether frames come when they come."""

    @abstractmethod
    def more(self) -> bool:
        """Append the next frame; return False where there is none."""

    def abilities(self) -> Abilities:
        """Return what one can do."""
        return Abilities()

    def change(self, observer: str | None = None, fault: Mapping[str, Any] | None = None) -> None:
        """Go through the episode again from its start to the present.

        Args:
            observer: name of the one that estimates now (None: the same).
            fault: changes of the scenario's dotted keys in place of those of an earlier fault (None: the same).

        Raises:
            CoopenvError: that is not valid, or nothing can be changed here; all is as before then.
        """
        raise CoopenvError("nothing can be changed here")

    def close(self) -> None:  # noqa: B027 (most hold nothing)
        """Let go of everything."""


class SavedReel(Reel):
    """The frames of a scene that a run has kept."""

    def __init__(self, record: SceneRecord) -> None:
        super().__init__(record.scenario, record.source, record.length)
        self._record = record

    def more(self) -> bool:
        """Append the next frame."""
        if len(self.frames) == len(self._record):
            return False
        self.frames.append(self._record.frame(len(self.frames)))
        return True


class EngineReel(Reel):
    """The frames of an episode that runs while it is watched."""

    def __init__(self, open_backend: Open, name: str, seed: int, driver: Driver) -> None:
        """Open the backend and build everything.

        Args:
            open_backend: returns the backend.
            name: of what is shown.
            seed: of the episode.
            driver: chooses the policy.

        Raises:
            CoopenvError: something of it cannot be.
        """
        self._open, self._name, self._seed, self._driver = open_backend, name, seed, driver
        self._observer: dict[str, Any] = {}
        self._fault: Mapping[str, Any] = {}
        engine, policy, source = self._built({})
        scenario = engine.backend.scenario
        super().__init__(scenario, source, scenario.horizon)
        self.real_time = engine.backend.capabilities.real_time
        self._begin(engine, policy)

    def _built(self, changes: Mapping[str, Any]) -> tuple[Engine, Policy | None, Source]:
        backend = self._open(changes)
        scenario, recorded = backend.scenario, backend.capabilities.recorded
        policy, driver = (None, "") if recorded else self._driver(scenario)
        seed = None if recorded or backend.capabilities.real_time else self._seed
        engine = Engine(scenario, backend=backend)
        engine.load()
        return engine, policy, Source.of(self._name, scenario, policy=driver, seed=seed)

    def _begin(self, engine: Engine, policy: Policy | None) -> None:
        self.engine, self._policy = engine, policy
        self._stride = max(1, round(engine.backend.scenario.rates.camera / MAX_FPS))
        self._ticks = self._played()

    def _played(self) -> Iterator[int]:
        ticks = self.engine.backend.scenario.horizon_ticks
        return play(self.engine, [self._seed], ticks, self._policy, to_the_end=False)

    def more(self) -> bool:
        """Run on to the next frame."""
        tick = next((tick for tick in self._ticks if tick % self._stride == 0), None)
        if tick is not None:
            self.frames.append(Frame.of(self.engine))
        return tick is not None

    def change(self, observer: str | None = None, fault: Mapping[str, Any] | None = None) -> None:
        """Build everything anew, and run up to where it was."""
        watching = self._observer if observer is None else {"observer.name": observer}
        wrong = self._fault if fault is None else fault
        engine, policy, source = self._built({**watching, **wrong})
        before = dict(vars(self))
        self._observer, self._fault = watching, wrong
        self.source, self.scenario = source, engine.backend.scenario
        self._begin(engine, policy)
        self.frames = []
        try:
            while len(self.frames) < len(before["frames"]) and self.more():
                pass
        except BaseException:
            vars(self).update(before)
            engine.close()
            raise
        before["engine"].close()

    def close(self) -> None:
        """Close the engine."""
        self.engine.close()

    def abilities(self) -> Abilities:
        """Return what one can do."""
        if self.real_time:
            return Abilities(pace=False, seek=False)
        from coopenv.observers.registry import available_names

        running = self.scenario.observer.name
        others = [name for name in available_names() if name != running]
        simulated = not self.engine.backend.capabilities.recorded
        return Abilities(observers=(running, *others), faults=tuple(FAULTS) if simulated else ())


def _corrupted(time: float, vehicle: int) -> dict[str, Any]:
    return {"faults.corruption.probability": 0.5, "faults.corruption.start": time}


def _lying(time: float, vehicle: int) -> dict[str, Any]:
    return {f"vehicles.{vehicle}.faults": {"lie": {"kind": "jump", "start": time}}}


def _restarting(time: float, vehicle: int) -> dict[str, Any]:
    return {f"vehicles.{vehicle}.faults": {"restart": {"chance": 1.0, "time": time}}}


def _losing(time: float, vehicle: int) -> dict[str, Any]:
    return {"v2x.loss": 0.5}


def _blurred(time: float, vehicle: int) -> dict[str, Any]:
    return {"camera.miss_probability": 0.5}


FAULTS: dict[str, Callable[[float, int], dict[str, Any]]] = {
    "half of the messages corrupted from now on": _corrupted,
    "picked vehicle lies by 5 m from now on": _lying,
    "picked vehicle's computer restarts now": _restarting,
    "half of the messages lost, whole episode": _losing,
    "half of the detections missed, whole episode": _blurred,
}
"""By name: what is changed of the scenario, for a time in s and a vehicle."""


def vehicle_index(scenario: Scenario, name: str | None) -> int | None:
    """Return the index of a vehicle by its name or by f1, f2, ...; None without a name.

    Raises:
        CoopenvError: there is no such vehicle.
    """
    if name is None:
        return None
    names = list(scenario.vehicle_names)
    short = {f"f{i + 1}": i for i in range(len(names))}
    if name in short:
        return short[name]
    if name not in names:
        raise CoopenvError(f"--vehicle {name}: no such vehicle{suggest(name, names)}; known: {listed(names)}")
    return names.index(name)
