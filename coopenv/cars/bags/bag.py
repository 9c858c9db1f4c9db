"""ROS bags of any laboratory as a backend, and what an unknown bag holds: rates, gaps and stamps of its topics.

A map gives car and content of each topic; one is proposed by the topics' types.
"""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, DataError, DataWarning, ScenarioWarning, check_one_of, listed
from coopenv.cars.backend.assembler import Assembler
from coopenv.cars.backend.binding import OPTIONS, bind, reset_options
from coopenv.cars.bags.log import read_log
from coopenv.cars.bags.topic_map import UNNEEDED, TopicMap, load_map
from coopenv.cars.bags.topics import NS
from coopenv.cars.doctor.finding import Finding, Treatment
from coopenv.cars.doctor.streams import TURNING, Streams
from coopenv.cars.messages.readings import Sample
from coopenv.cars.settings.profile import Role
from coopenv.scenario import Scenario, load_scenario
from coopenv.sources.base import Capabilities, TickGenerator, TickStream
from coopenv.sources.selection import WHOLE, Selection
from coopenv.sources.worlds import without_robots

AHEAD = 100_000_000
"""ns by which motion capture is read ahead of a tick, so that the truth lies between two of its poses."""

LONGEST_GAP = 600.0  # s without any message that is needed

OFF = 0.1
"""Share by which the rate of a camera may differ from the environment's without a warning."""
SPARSE = 0.4  # share of the environment's samples of odometry with turn rates at least; half are common

ENDLESS = {
    "termination.arrival": False,
    "termination.collision": False,
    "termination.off_route": None,
    "termination.after_arrival": "park",
}
"""Overrides by which a recorded drive and its errors continue beyond goals and contacts of the environment."""


class Bag(TickGenerator):
    """Bags as a backend. Ticks are the same in every episode; actions change nothing.

    An episode lasts as long as the bag: goals, routes and contacts end it where overrides set `termination` so. A car
    whose odometry is silent continues with its last twist, and its frames count.

    Tick 0 is one and a half camera periods after everything that is needed has begun to come, so that in what follows
    a tick is half a period behind the frames of the camera that began last. Initial estimates and radio are those of
    the environment: a seed draws them where they are random.
    """

    options = OPTIONS

    def __init__(
        self,
        paths: Sequence[str | Path],
        topics: str | Path | TopicMap,
        overrides: Mapping[str, Any] | None = None,
        start: float = 0.0,
        until: float | None = None,
        robots: Sequence[str] | None = None,
        trust: Sequence[str] = (),
    ) -> None:
        """Read bags.

        Args:
            paths: of one recording; files or folders of ROS 1 or 2, for example one per car.
            topics: the map, see docs/bags.md.
            overrides: dotted keys of its environment, for example another observer's name; `horizon` shortens it.
            start: time of tick 0 after that of the whole bag, s.
            until: time of the last tick after that, s; None: as long as there is data.
            robots: cars that are used, by their names or those of their vehicles; None: all.
            trust: subjects of findings that are used unchanged, after those of the map.

        Raises:
            TopicMapError: the map is not valid.
            DataError: a bag cannot be read, or something that is needed is missing.
            CoopenvError: the environment or an override is not valid.
        """
        given = topics if isinstance(topics, TopicMap) else load_map(topics)
        self.map = given.model_copy(update={"trust": (*given.trust, *trust)})
        self.changes = changes = {**ENDLESS, **self.map.overrides, **(overrides or {})}
        changes |= self._decisions(changes)
        self.where = ", ".join(str(path) for path in paths)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ScenarioWarning)  # repeated below
            scenario = load_scenario(self.map.environment_path, changes)
        self._rate = float(scenario.rates.camera)
        where = self.map.path.name
        self.binding = bind(scenario, self.map.cars, self.map.markers, where, None, self.map.make, calibrated=False)
        self.kept = self._kept(robots)
        read = [car for car in self.map.cars if self.binding.cars.get(car.name, self.kept[0]) in self.kept]
        self.log = read_log([Path(path) for path in paths], self.map.model_copy(update={"cars": read}), self.binding)
        self._begin, ticks = self._ticks(start, until)
        scenario = without_robots(self._scenario(changes, ticks), self.kept)
        self._check_trust()
        really = dict.fromkeys(f.subject for f in self.log.findings if f.treatment is Treatment.TRUSTED)
        if remark := Selection(trust=(*really,)).remark:
            scenario = scenario.model_copy(update={"title": scenario.title + remark})
        self.binding = replace(self.binding, scenario=scenario)
        known = any(sample.role is Role.TRUTH for sample in self.log.samples)
        here = self.kept if robots is not None else None
        super().__init__(scenario, Capabilities(known, False, False, ticks, False, True, here))
        self.notes = (*self.log.notes, *self._odd_rates(), *self._odd_markers())
        for note in (*self.notes, *map(str, self.log.findings)):
            warnings.warn(f"{self.where}: {note}", DataWarning, stacklevel=2)

    def _decisions(self, changes: Mapping[str, Any]) -> dict[str, float]:
        """Return the rate of decisions, which a recording has not, such that the camera's may be any."""
        rate = changes.get("rates.camera")
        if not isinstance(rate, int | float) or rate <= 0.0 or "rates.decision" in changes:
            return {}
        decision = load_scenario(self.map.environment_path).rates.decision
        return {"rates.decision": rate / math.ceil(rate / decision - 1e-9)}

    def _check_trust(self) -> None:
        """Raise DataError: something to be trusted is no stream of the bag."""
        topics = [row.topic for row in self.log.rows if row.role]
        cars = [name for car in self.binding.cars for name in (car, f"camera of {car}")]
        known = dict.fromkeys(["all", *topics, "landmarks", "markers", *cars, *(f.subject for f in self.log.findings)])
        for name in self.map.trust:
            if ":" not in name:  # of a part of a car or the map
                check_one_of(f"{self.where}: trust: unknown stream", name, [*known], DataError)

    def _kept(self, robots: Sequence[str] | None) -> tuple[int, ...]:
        """Return the vehicles of some cars; None: of all."""
        numbers = {**self.binding.cars} | {
            self.binding.scenario.vehicle_names[i]: i for i in self.binding.cars.values()
        }
        for name in robots or ():
            check_one_of(f"{self.where}: robots: unknown robot", name, numbers, DataError)
        return tuple(sorted({numbers[name] for name in (self.binding.cars if robots is None else robots)}))

    def _ticks(self, start: float, until: float | None) -> tuple[int, int]:
        """Return when tick 0 is, ns, and how many ticks there are, of a part from and to times in s."""
        needed = [s for s in self.log.samples if s.car in self.binding.cars and s.role not in UNNEEDED]
        first = {(s.car, s.role): s.stamp for s in reversed(needed)}
        begin = max(first.values()) + round(self.map.start * NS) + round(1.5 * NS / self._rate)
        end = needed[-1].stamp
        if self.map.duration is not None:
            end = min(end, begin + round(self.map.duration * NS))
        for option, time in (("from", start), ("until", until or 0.0)):
            if time * NS > max(0, end - begin):
                length = max(0.0, (end - begin) / NS)
                raise DataError(f"{self.where}: {option}: {time:g} s; {length:.4g} s are recorded")
        end = end if until is None else begin + round(until * NS)
        begin += round(start * NS)
        stamps = np.array([begin, *(s.stamp for s in needed if begin < s.stamp < end), end])
        gaps = np.diff(stamps)
        if gaps.max() > LONGEST_GAP * NS:
            after, silent = (stamps[np.argmax(gaps)] - begin) / NS, gaps.max() / NS
            text = f"{self.where}: nothing for {silent:.4g} s after {after:.4g} s, as of a clock that was set"
            raise DataError(f"{text}; start and duration in {self.map.path.name} choose a part")
        ticks = int((end - begin) * self._rate / NS + 0.5 + 1e-6) + 1  # the last one is half a period after its frame
        if end < begin or ticks < 2:
            span = max(0.0, (end - begin) / NS)
            raise DataError(
                f"{self.where}: {span:.3g} s in which everything that is needed comes, too few for two ticks"
            )
        return begin, ticks

    def _scenario(self, changes: dict[str, Any], ticks: int) -> Scenario:
        """Return the environment with the bag's length as its horizon."""
        longest = (ticks - 1) / self._rate
        asked = changes.get("horizon", longest)
        scenario = load_scenario(self.map.environment_path, {**changes, "horizon": asked})
        if scenario.horizon_ticks > ticks - 1:
            raise CoopenvError(f"horizon: {scenario.horizon:g} s are more than {self.where} has ({longest:.4g} s)")
        return scenario

    def _odd_rates(self) -> Iterator[str]:
        topics, samples = self.log.streams.topics, self.scenario.rates.odometry
        turning = {next((topics[car, r] for r in TURNING if (car, r) in topics), "") for car in self.binding.cars}
        for row in self.log.rows:
            if row.role in (Role.DETECTIONS, Role.BEARINGS) and row.rate and abs(row.rate / self._rate - 1.0) > OFF:
                hint = f'set overrides = {{ "rates.camera" = {float(f"{row.rate:.3g}")} }} in the map'
                yield f"{row.topic}: {row.rate:.1f} frames per second, the environment has {self._rate:g}: {hint}"
            if row.topic in turning and row.rate and row.rate < SPARSE * samples:
                hint = f'set overrides = {{ "rates.odometry" = {float(f"{row.rate:.3g}")} }} in the map'
                yield f"{row.topic}: {row.rate:.1f} messages per second, the environment has {samples:g}: {hint}"

    def _odd_markers(self) -> Iterator[str]:
        """Yield which markers of the map were never detected, and how often others were."""
        names, found = self.scenario.target_names, set[int]()
        for sample in self.log.samples:
            found |= {*getattr(sample.value, "markers", ())} if sample.car in self.binding.cars else set()
        landmarks = {
            n: names[target] for n, target in self.binding.targets.items() if target < len(self.scenario.landmarks)
        }
        unseen = [f"{number} ({name})" for number, name in sorted(landmarks.items()) if number not in found]
        if unseen:
            yield f"markers of landmarks that were never detected: {listed(unseen)}"
        if others := self.log.unknown_markers:
            counts = [f"{number} ({count} times)" for number, count in sorted(others.items())]
            yield f"detected markers that are not in the map: {listed(counts)}"

    @property
    def streams(self) -> Streams:
        """Every stream once, on one clock."""
        return replace(self.log.streams, binding=self.binding)

    @property
    def refused(self) -> list[Finding]:
        """Contradictions of streams that estimates cannot stand."""
        return [finding for finding in self.log.findings if finding.treatment is Treatment.REFUSED]

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> TickStream:
        """Go through the bags tick by tick; the option `arm` has no effect.

        Raises:
            DataError: streams contradict each other in a way that estimates cannot stand, and are not trusted.
        """
        reset_options(options)
        if refused := self.refused:
            more = f" (and {len(refused) - 1} more: coopenv doctor)" if len(refused) > 1 else ""
            raise DataError(f"{self.where}: {refused[0]}; --trust '{refused[0].subject}' uses it unchanged{more}")
        assembler, samples, following = Assembler(self.binding), sorted(self.log.samples, key=_used), 0
        for k in range(self.scenario.horizon_ticks + 1):
            now = self._begin + round(k * NS / self._rate)
            while following < len(samples) and _used(samples[following]) <= now:
                assembler.put(samples[following])
                following += 1
            tick = assembler.begin(now) if k == 0 else assembler.tick(k, now)
            missing = tick.filled("missing")
            yield replace(tick, missing=missing & ~tick.visible.any(axis=1))


def _used(sample: Sample) -> int:
    """Return when a sample is put in, ns."""
    return sample.stamp - AHEAD if sample.role is Role.TRUTH else sample.stamp


def open_bags(
    names: str | Path | Sequence[str | Path],
    overrides: Mapping[str, Any] | None = None,
    topics: str | Path | None = None,
    selection: Selection = WHOLE,
) -> Bag:
    """Return ROS bags of one drive as a backend; arguments and errors as for `open_backend`."""
    paths = [names] if isinstance(names, str | Path) else names
    where = ", ".join(str(path) for path in paths)
    missing = [str(path) for path in paths if not Path(path).exists()]
    if missing:
        raise DataError(f"no such bag: {', '.join(missing)}")
    if topics is None:
        raise DataError(f"{where}: a ROS bag, which needs a map of its topics, --map topics.toml (see docs/bags.md)")
    return Bag(paths, topics, overrides, selection.start or 0.0, selection.until, selection.robots, selection.trust)
