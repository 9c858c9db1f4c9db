"""A ROS bag in the place of the simulated world."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.backends.base import Capabilities, Episode, TickGenerator
from coopenv.base.errors import CoopenvError, DataError, DataWarning, ScenarioWarning
from coopenv.cars.backend.assembler import Assembler
from coopenv.cars.backend.binding import OPTIONS, bind, reset_options
from coopenv.cars.bags.files import check_extra
from coopenv.cars.bags.log import NS, read_log
from coopenv.cars.bags.topic_map import UNNEEDED, TopicMap, load_map
from coopenv.cars.profile import Role
from coopenv.cars.readings import Sample
from coopenv.scenario import Scenario, load_scenario

AHEAD = 100_000_000
"""ns by which motion capture is read ahead of a tick, so that the truth lies between two of its poses."""

LONGEST_GAP = 600.0  # s without any message that is needed

OFF = 0.1
"""Share by which the rate of a camera may differ from the environment's without a warning."""


class Bag(TickGenerator):
    """Bags as a backend. Ticks are the same in every episode; actions change nothing.

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
    ) -> None:
        """Read bags.

        Args:
            paths: of one recording; files or folders of ROS 1 or 2, for example one per car.
            topics: the map, see docs/bags.md.
            overrides: dotted keys of its environment, for example another observer's name; `horizon` shortens it.

        Raises:
            TopicMapError: the map is not valid.
            DataError: a bag cannot be read, or something that is needed is missing.
            CoopenvError: the environment or an override is not valid, or the extra is not installed.
        """
        check_extra()
        self.map = topics if isinstance(topics, TopicMap) else load_map(topics)
        self.changes = changes = {**self.map.overrides, **(overrides or {})}
        self.where = ", ".join(str(path) for path in paths)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ScenarioWarning)  # repeated below
            scenario = load_scenario(self.map.environment_path, changes)
        self._rate = float(scenario.rates.camera)
        self.binding = bind(scenario, self.map.cars, self.map.markers, self.map.path.name, None, self.map.make)
        self.log = read_log([Path(path) for path in paths], self.map, self.binding)
        self._begin, ticks = self._ticks()
        scenario = self._scenario(changes, ticks)
        self.binding = replace(self.binding, scenario=scenario)
        known = any(sample.role is Role.TRUTH for sample in self.log.samples)
        super().__init__(scenario, Capabilities(known, False, False, ticks, batched=False, recorded=True))
        for note in (*self.log.notes, *self._odd_rates()):
            warnings.warn(f"{self.where}: {note}", DataWarning, stacklevel=2)

    def _ticks(self) -> tuple[int, int]:
        """Return when tick 0 is, ns, and how many ticks there are."""
        needed = [s for s in self.log.samples if s.car in self.binding.cars and s.role not in UNNEEDED]
        first = {(s.car, s.role): s.stamp for s in reversed(needed)}
        begin = max(first.values()) + round(self.map.start * NS) + round(1.5 * NS / self._rate)
        end = needed[-1].stamp
        if self.map.duration is not None:
            end = min(end, begin + round(self.map.duration * NS))
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
        for row in self.log.rows:
            if row.role in (Role.DETECTIONS, Role.BEARINGS) and row.rate and abs(row.rate / self._rate - 1.0) > OFF:
                hint = f'set overrides = {{ "rates.camera" = {row.rate:.0f}.0 }} in the map'
                yield f"{row.topic}: {row.rate:.1f} frames per second, the environment has {self._rate:g}: {hint}"

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> Episode:
        """Go through the bags tick by tick; the option `arm` has no effect."""
        reset_options(options)
        assembler, samples, following = Assembler(self.binding), sorted(self.log.samples, key=_used), 0
        for k in range(self.scenario.horizon_ticks + 1):
            now = self._begin + round(k * NS / self._rate)
            while following < len(samples) and _used(samples[following]) <= now:
                assembler.put(samples[following])
                following += 1
            yield assembler.begin(now) if k == 0 else assembler.tick(k, now)


def _used(sample: Sample) -> int:
    """Return when a sample is put in, ns."""
    return sample.stamp - AHEAD if sample.role is Role.TRUTH else sample.stamp
