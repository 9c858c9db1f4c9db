"""ROS bags of any laboratory as a backend, and what an unknown bag holds: rates, gaps and stamps of its topics.

A map gives car and content of each topic; one is proposed by the topics' types.
"""

import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.backends.base import Capabilities, Episode, TickGenerator
from coopenv.backends.worlds import without_robots
from coopenv.base.errors import CoopenvError, DataError, DataWarning, ScenarioWarning, check_one_of, listed, printable
from coopenv.cars.backend.assembler import BROADCAST, Assembler
from coopenv.cars.backend.binding import OPTIONS, bind, marker_places, reset_options
from coopenv.cars.bags.clocks import checked, misfit_of_truth
from coopenv.cars.bags.files import BagFile, check_extra
from coopenv.cars.bags.log import NS, TopicRow, read_log, regularity
from coopenv.cars.bags.topic_map import READ, UNNEEDED, TopicMap, load_map
from coopenv.cars.profile import IMAGES, SVEA, VELOCITY, Role
from coopenv.cars.readings import POSES, READERS, CarPose, Sample, read
from coopenv.cars.sensor_settings import TOPIC
from coopenv.cars.vision import Calibration
from coopenv.estimation.poses import MISFIT_DEG
from coopenv.scenario import Scenario, load_scenario

AHEAD = 100_000_000
"""ns by which motion capture is read ahead of a tick, so that the truth lies between two of its poses."""

LONGEST_GAP = 600.0  # s without any message that is needed

FAR = 10.0
"""Times the extent of the landmarks, beyond which motion capture is warned of."""

OFF = 0.1
"""Share by which the rate of a camera may differ from the environment's without a warning."""


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
    ) -> None:
        """Read bags.

        Args:
            paths: of one recording; files or folders of ROS 1 or 2, for example one per car.
            topics: the map, see docs/bags.md.
            overrides: dotted keys of its environment, for example another observer's name; `horizon` shortens it.
            start: time of tick 0 after that of the whole bag, s.
            until: time of the last tick after that, s; None: as long as there is data.
            robots: cars that are used, by their names or those of their vehicles; None: all.

        Raises:
            TopicMapError: the map is not valid.
            DataError: a bag cannot be read, or something that is needed is missing.
            CoopenvError: the environment or an override is not valid, or the extra is not installed.
        """
        check_extra()
        self.map = topics if isinstance(topics, TopicMap) else load_map(topics)
        self.changes = changes = {**ENDLESS, **self.map.overrides, **(overrides or {})}
        self.where = ", ".join(str(path) for path in paths)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ScenarioWarning)  # repeated below
            scenario = load_scenario(self.map.environment_path, changes)
        self._rate = float(scenario.rates.camera)
        self.binding = bind(scenario, self.map.cars, self.map.markers, self.map.path.name, None, self.map.make)
        self.kept = self._kept(robots)
        read = [car for car in self.map.cars if self.binding.cars.get(car.name, self.kept[0]) in self.kept]
        self.log = read_log([Path(path) for path in paths], self.map.model_copy(update={"cars": read}), self.binding)
        self._begin, ticks = self._ticks(start, until)
        scenario = without_robots(self._scenario(changes, ticks), self.kept)
        self.binding = replace(self.binding, scenario=scenario)
        known = any(sample.role is Role.TRUTH for sample in self.log.samples)
        here = self.kept if robots is not None else None
        super().__init__(scenario, Capabilities(known, False, False, ticks, False, True, here))
        for note in (*self.log.notes, *self._odd_rates(), *self._odd_markers(), *self._far_truth()):
            warnings.warn(f"{self.where}: {note}", DataWarning, stacklevel=2)

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
        for row in self.log.rows:
            if row.role in (Role.DETECTIONS, Role.BEARINGS) and row.rate and abs(row.rate / self._rate - 1.0) > OFF:
                hint = f'set overrides = {{ "rates.camera" = {row.rate:.0f}.0 }} in the map'
                yield f"{row.topic}: {row.rate:.1f} frames per second, the environment has {self._rate:g}: {hint}"

    def _far_truth(self) -> Iterator[str]:
        """Yield the cars whose motion capture is far from all landmarks, or does not fit to their bearings."""
        places, hint = marker_places(self.scenario.landmarks)[:, :2], "are its unit (m) and frames.truth right?"
        width = float(np.linalg.norm(np.ptp(places, axis=0))) if len(places) else 0.0
        for car in self.binding.cars if width > 0.0 else ():
            found = [s.value for s in self.log.samples if (s.car, s.role) == (car, Role.TRUTH)]
            at = np.array([value.position[:2] for value in found if isinstance(value, CarPose)]).reshape(-1, 1, 2)
            away = float(np.median(np.linalg.norm(at - places, axis=-1).min(axis=-1))) if len(at) else 0.0
            misfit, topic = misfit_of_truth(self.log.samples, car, self.binding), f"motion capture of {car}"
            if topics := [row.topic for row in self.log.rows if (row.car, row.role) == (car, Role.TRUTH.value)]:
                topic += f", topic {topics[0]},"
            if away > FAR * width:
                yield f"{topic} is {away:.3g} m from landmarks that span {width:.3g} m: {hint}"
            elif misfit > MISFIT_DEG:
                why = "are its heading (rad), unit (m) and frames.truth right, and the markers?"
                yield f"{topic} is {misfit:.0f} deg off the bearings to landmarks (median): {why}"

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

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> Episode:
        """Go through the bags tick by tick; the option `arm` has no effect."""
        reset_options(options)
        assembler, samples, following = Assembler(self.binding), sorted(self.log.samples, key=_used), 0
        for k in range(self.scenario.horizon_ticks + 1):
            now = self._begin + round(k * NS / self._rate)
            while following < len(samples) and _used(samples[following]) <= now:
                assembler.put(samples[following])
                following += 1
            tick = assembler.begin(now) if k == 0 else assembler.tick(k, now)
            missing = np.zeros(len(tick.visible), bool) if tick.missing is None else tick.missing
            yield replace(tick, missing=missing & ~tick.visible.any(axis=1))


def _used(sample: Sample) -> int:
    """Return when a sample is put in, ns."""
    return sample.stamp - AHEAD if sample.role is Role.TRUTH else sample.stamp


CAPTURE = re.compile(r"qualisys|mocap|vicon|optitrack|vrpn|truth|ground", re.IGNORECASE)
"""Pattern in names of topics of motion capture."""
COMMANDED = re.compile(r"cmd|command|setpoint|target", re.IGNORECASE)
"""Pattern in names of topics of commands, whose types are those of measured twists."""
ANY_CAMERA = Calibration((100_000, 100_000), (1e5, 1e5), (5e4, 5e4), (0.0,) * 5)
"""Intrinsics for which every detection is inside the image."""
TO_WHEELS = (SVEA.topics[Role.MANUAL].type,)
DRIFTING = 1e-5  # s per s from which a clock's drift is mentioned


def examined(files: Sequence[BagFile]) -> tuple[tuple[TopicRow, ...], tuple[str, ...]]:
    """Return a row per topic, and what is wrong with stamps, a line each."""
    times = [file.times() for file in files]
    rows, notes = [], list[str]()
    for name in sorted({name for found in times for name in found}):
        kind = next(file.topics[name] for file in files if name in file.topics)
        parts = [found[name] for found in times if name in found]
        received = np.sort(np.concatenate([received for _, received in parts]))
        rate, gap, gaps = regularity(received)
        wrong, offset = 0, None
        for stamps, arrived in parts:
            bad, delay = checked(stamps, arrived)
            if delay is None:
                continue
            wrong, offset = wrong + int(bad.sum()), delay.offset / NS
            if not stamps.all():
                notes.append(f"{name}: {int((stamps == 0).sum())} of {len(stamps)} stamps are 0")
            if abs(delay.drift) > DRIFTING:
                notes.append(f"{name}: its clock drifts by {1e6 * delay.drift:+.0f} us per s")
            if delay.jump:
                notes.append(f"{name}: its clock jumps by {delay.jump / NS:.2g} s")
        if wrong:
            notes.append(f"{name}: {wrong} of {len(received)} stamps are wrong, and will be left out")
        rows.append(TopicRow(name, kind, len(received), rate, gap=gap, gaps=gaps, offset=offset, outlying=wrong))
    return tuple(rows), tuple(notes)


def proposed(files: Sequence[BagFile], rows: Sequence[TopicRow]) -> str:
    """Return a map of bags with such topics, as TOML text. Raises CoopenvError: no topic has detections of a camera."""
    cars = cars_of(rows)
    used = {name for topics in cars.values() for name in topics.values()}
    markers = ", ".join(f"{number} ({count} frames)" for number, count in sorted(_markers(files, used).items()))
    none = "images ([vision]: their tags)" if any(r.type in IMAGES and r.topic in used for r in rows) else "no marker"
    lines = [
        "# Proposed by names and types of topics: check every line.",
        'environment = "my_environment.toml" # landmarks, camera, noise: a name (coopenv list), or a file beside this',
        'names = "none"',
        f"# The camera has seen {markers or none}.",
        "markers = {} # numbers by name of the landmark: { SL1 = 1 }",
    ]
    for car, topics in cars.items():
        lines += ["", "[[cars]]", f'name = "{car}"', "# marker = 7 # its own, seen by other cars"]
        lines += ['# vehicle = "vehicle_1" # of the environment (default: in the order of this file)', "[cars.topics]"]
        lines += [f'{role.value} = "{name}"' for role, name in topics.items()]
    kinds = [row for row in rows if row.topic not in used]
    lines += ["", "# Not used:", *(printable(f"#   {row.topic} ({row.type})") for row in kinds)] if kinds else []
    return "\n".join(lines) + "\n"


def cars_of(rows: Sequence[TopicRow]) -> dict[str, dict[Role, str]]:
    """Return the topics by role of every car with a camera, by the part of the names that differs between cars."""
    roles = {row.topic: role for row in rows if (role := role_of(row)) is not None}
    cameras = next((t for r in (Role.DETECTIONS, Role.BEARINGS) if (t := [n for n in roles if roles[n] is r])), [])
    if not cameras:
        kinds = ", ".join(kind for role in (Role.DETECTIONS, Role.BEARINGS) for kind in READERS[role])
        raise CoopenvError(f"no map can be proposed: no topic has detections of a camera ({kinds})")
    found: dict[str, dict[Role, str]] = {}
    for car, names in _owned(cameras, roles):
        best = sorted((row for row in rows if row.topic in names), key=lambda row: row.messages)
        by_role = {roles[row.topic]: row.topic for row in best}
        found[car] = {role: by_role[role] for role in READ if role in by_role and role not in BROADCAST}
    return found


def _owned(cameras: Sequence[str], roles: Mapping[str, Role]) -> Iterator[tuple[str, set[str]]]:
    """Yield cars and their topics: those that have the name of the car as a part."""
    parts = [camera.split("/") for camera in cameras]
    if len(cameras) > 1:
        place = next(k for k in range(max(map(len, parts))) if len({tuple(p[k : k + 1]) for p in parts}) > 1)
        for own in parts:
            yield _name(own[place]), {name for name in roles if own[place] in name.split("/")}
        return
    moving = [name.split("/") for name, role in roles.items() if any(role in some for some in VELOCITY.values())]
    shared = [part for k, part in enumerate(parts[0]) if any(other[: k + 1] == parts[0][: k + 1] for other in moving)]
    yield _name(shared[-1] if shared else ""), set(roles)


def _name(part: str) -> str:
    """Return a name of a car."""
    text = re.sub(r"\W", "_", part)
    return text if text[:1].isalpha() else f"car_{text}".rstrip("_")


def role_of(row: TopicRow) -> Role | None:
    """Return the role of a topic by its type, and by its name where that leaves several."""
    if COMMANDED.search(row.topic) or not re.match(TOPIC, row.topic):
        return None
    if row.type in POSES and CAPTURE.search(row.topic):
        return Role.TRUTH
    order = (Role.ODOMETRY, *READ) if row.type == "nav_msgs/msg/Odometry" else (Role.WHEEL, *READ)
    return next((role for role in order if role in READ and row.type in READERS.get(role, TO_WHEELS)), None)


def _markers(files: Sequence[BagFile], used: set[str]) -> Counter[int]:
    """Return in how many frames each marker was detected on the topics that are used. Images are not searched."""
    found: Counter[int] = Counter()
    for file in files:
        for role in (Role.DETECTIONS, Role.BEARINGS):
            kinds = READERS[role].keys() - IMAGES
            for _, _, decode in file.messages([name for name in used if file.topics.get(name) in kinds]):
                with suppress(CoopenvError):
                    found.update(getattr(read(role, decode(), ANY_CAMERA), "markers", ()))
    return found
