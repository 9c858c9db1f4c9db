"""Sources of ticks by name.

A wrong name is an error before any of the simulation is loaded.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

from coopenv.base.errors import CoopenvError, DataError, check_one_of, shown
from coopenv.base.installation import list_envs

if TYPE_CHECKING:
    from typing_extensions import TypeIs

    from coopenv.backends.base import Backend
    from coopenv.backends.worlds import Simulated
    from coopenv.cars.bags.bag import Bag
    from coopenv.observers.recording import Recording
    from coopenv.scenario import Scenario, ScenarioLike

BACKENDS = ("simulated", "highway", "sumo", "program", "replay", "svea")

LOG_SUFFIX = ".mcap"
BAG_SUFFIXES = (".bag", ".db3")
DRIVE = "coopenv-drive"
OURS = {"coopenv", DRIVE}
"""Names of the metadata of MCAP files that are no bags of others."""
DATASETS = re.compile(r"mrclam_\d+(_space)?")


IMPORT = "coopenv import {} --map topics.toml --out FILE.mcap"


class SourceKind(Enum):
    """Kind of source that a name denotes."""

    ENVIRONMENT = "an environment by name or TOML file"
    LOG = "an MCAP file"
    DATASET = "a sub-dataset of MR.CLAM"
    BAG = "a ROS bag, which needs a map of its topics"


@dataclass(frozen=True)
class Selection:
    """The part of recorded data that is used.

    Robots that are left out are neither estimated nor judged, and the others neither measure nor receive them.
    """

    start: float | None = None
    """Time of tick 0 in the recorded data, s; None: their begin."""
    until: float | None = None
    """Time of the last tick in the recorded data, s; None: their end."""
    robots: tuple[str, ...] | None = None
    """Names, such as vehicle_1; None: all."""

    @classmethod
    def of(cls, start: float | None, until: float | None, robots: Sequence[str | int] | str | int | None) -> Selection:
        """Return a checked selection.

        Args:
            start: begin, s.
            until: end, s.
            robots: names or numbers, 1 for vehicle_1; a text has commas between them.

        Raises:
            CoopenvError: times are not in order, or there are no robots.
        """
        for option, time in (("from", start), ("until", until)):
            number = isinstance(time, Real) and not isinstance(time, bool) and 0.0 <= float(time) < math.inf
            if time is not None and not number:
                raise CoopenvError(f"{option}: expected a time of at least 0 s, got {shown(time)}")
        if until is not None and until <= (start or 0.0):
            raise CoopenvError(f"until: {until:g} s are not after the start at {start or 0.0:g} s")
        given: Any = str(robots).split(",") if isinstance(robots, str | Real) else robots
        given = given if given is None or isinstance(given, Iterable) else ()
        names = None if given is None else tuple(dict.fromkeys(_robot_name(robot) for robot in given))
        if names is not None and ("" in names or not names):
            raise CoopenvError(f"robots: expected names or numbers such as 1,3, got {shown(robots)}")
        return cls(start, until, names)

    @property
    def given(self) -> dict[str, Any]:
        """Selected values by option."""
        values = {"from": self.start, "until": self.until, "robots": self.robots and ",".join(self.robots)}
        return {option: value for option, value in values.items() if value is not None}

    def applied(self, recording: Recording, where: str) -> Recording:
        """Return the selected part of a recording, whose name is for errors.

        The start is that of a tick at which messages are sent. Initial estimates keep their errors: those at the begin
        of the recording, relative to the true pose.

        Raises:
            DataError: it has no such time or robot, or true poses at the start are not known.
        """
        if not self.given:
            return recording
        from coopenv.backends.worlds import of_robots, stretch

        names = [setup.name for setup in recording.setups]
        for name in self.robots or ():
            check_one_of(f"{where}: robots: unknown robot", name, names, DataError)
        if self.robots is not None:
            recording = of_robots(recording, [i for i, name in enumerate(names) if name in self.robots])
        if self.start is None and self.until is None:
            return recording
        length, period = float(recording.t[-1]), recording.period
        first = math.ceil((self.start or 0.0) / recording.dt / period - 1e-6) * period
        last = recording.ticks - 1 if self.until is None else round(self.until / recording.dt)
        if last >= recording.ticks or first >= last:
            beyond = self.start is not None and (self.until is None or self.start > length)
            option, time = ("from", self.start) if beyond else ("until", self.until)
            raise DataError(f"{where}: {option}: {time:g} s; {length:g} s are recorded, in steps of {recording.dt:g} s")
        return stretch(recording, first, last, where)


WHOLE = Selection()
"""Everything that is recorded."""


def _robot_name(robot: Any) -> str:
    text = str(robot).strip()
    return f"vehicle_{text}" if text.isdigit() else text


def kind_of(name: ScenarioLike) -> SourceKind:
    """Return the kind of source of a name, which need not exist."""
    if is_bag(name):
        return SourceKind.BAG
    if str(name).endswith(LOG_SUFFIX):
        return SourceKind.LOG
    return SourceKind.DATASET if DATASETS.fullmatch(str(name)) else SourceKind.ENVIRONMENT


def is_bag(name: ScenarioLike, topics: str | Path | None = None) -> TypeGuard[str | Path]:
    """Return whether a name is that of a ROS bag; of MCAP files it is whatever coopenv has not written.

    With the map of its topics given it is one as well if it cannot be read, if it is a folder, and if it is a drive of
    cars: that is both. A folder that is called like an environment is ./NAME, unless a map is given.
    """
    if not isinstance(name, str | Path):
        return False
    if str(name).endswith(BAG_SUFFIXES):
        return True
    if str(name).endswith(LOG_SUFFIX):
        from coopenv.backends.mcap_format import metadata_names

        metadata = metadata_names(name)
        if metadata is None or DRIVE in metadata:
            return topics is not None
        return not metadata & OURS
    if str(name) in list_envs() and topics is None:
        return False
    try:
        return (Path(name) / "metadata.yaml").is_file() or (topics is not None and Path(name).is_dir())
    except (OSError, ValueError):  # no valid path
        return False


OBJECT = "recording"
"""Name of a `Recording` that is given as an object."""


def is_recording(given: Any) -> TypeIs[Recording]:
    """Return whether a `Recording` is given, not the name of one."""
    module = sys.modules.get("coopenv.observers.recording")  # loaded if there is one
    return module is not None and isinstance(given, module.Recording)


def source_name(given: ScenarioLike | Recording) -> str:
    """Return what results call a source, see `scenario_name`."""
    from coopenv.scenario import scenario_name

    return OBJECT if is_recording(given) else scenario_name(given)


def is_recorded(name: ScenarioLike) -> TypeGuard[str | Path]:
    """Return whether a name is that of a recording and not of an environment."""
    return kind_of(name) is not SourceKind.ENVIRONMENT


def open_recording(
    name: str | Path,
    data: str | Path | None = None,
    variant: str | None = None,
    selection: Selection = WHOLE,
) -> Recording:
    """Read a recording.

    Args:
        name: path of an MCAP file, or `mrclam_1` .. `mrclam_9`, with `_space` for observers in space.
        data: folder of the data sets (None: that of COOPENV_DATA).
        variant: of a data set: "landmarks", "landmarks+robots" (as recorded, the default) or "blind".
        selection: the part that is used.

    Raises:
        CoopenvError: no such recording or variant, or the file is not what it should be.
    """
    kind = kind_of(name)
    if kind is SourceKind.LOG:
        if variant is not None:
            raise DataError(f"{name}: a file has no variants, got variant '{variant}'")
        from coopenv.backends.mcap import read_recording

        return selection.applied(read_recording(name), str(name))
    if kind is SourceKind.BAG:
        raise DataError(f"{name}: a ROS bag; make a recording of it with: {IMPORT.format(name)}")
    if kind is not SourceKind.DATASET:
        raise DataError(f"'{name}' is no recording; known: FILE{LOG_SUFFIX}, mrclam_1 .. mrclam_9")
    from coopenv.backends.mrclam import check_variant, load_dataset, recording_of
    from coopenv.backends.mrclam_dataset import IN_SPACE

    chosen = check_variant(variant or "landmarks+robots")  # before much is read
    in_space = str(name).endswith(IN_SPACE)
    recording = recording_of(load_dataset(str(name).removesuffix(IN_SPACE), data), chosen, in_space)
    return selection.applied(recording, str(name))


def open_simulation(name_or_path: ScenarioLike, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """Return the scenario of an environment that is to be simulated in many worlds.

    Raises:
        CoopenvError: there is none of that name, or it is recorded, or an override is not valid.
    """
    if is_recorded(name_or_path):
        raise CoopenvError(f"'{name_or_path}' is recorded, which is one world: replay it with parallel_env")
    from coopenv.scenario import load_scenario

    return load_scenario(name_or_path, overrides)


def simulation_of(scenario: Scenario) -> Simulated:
    """Return the simulation of a scenario, by its key `backend`.

    Raises:
        CoopenvError: an extra is missing, or the section of the backend is not valid.
    """
    if scenario.cosimulator is not None:
        from coopenv.backends.cosimulation import Cosimulated

        return Cosimulated(scenario)
    if scenario.sensing == "images":
        from coopenv.cars.frames import Rendered

        return Rendered(scenario)
    from coopenv.backends.worlds import Simulated

    return Simulated(scenario)


def open_backend(
    name_or_path: ScenarioLike | Recording,
    backend: str | Backend | None,
    overrides: Mapping[str, Any],
    data: str | Path | None = None,
    variant: str | None = None,
    cars: Mapping[str, Any] | None = None,
    topics: str | Path | None = None,
    selection: Selection = WHOLE,
) -> Backend:
    """Return the source of ticks of an environment or a recording.

    Args:
        name_or_path: what `load_scenario` takes, or MCAP file, ROS bag, data set or `Recording`.
        backend: one of `BACKENDS`; None: by the name; a backend itself is returned as it is.
        overrides: dotted scenario keys.
        data: folder of the data sets.
        variant: of a data set.
        cars: arguments of `coopenv.cars.backend.backend.open_svea`, which `backend="svea"` needs: `deployment`, and
            `car`, `record` and `connect`.
        topics: map of the topics of a ROS bag.
        selection: the part of recorded data that is used.

    Raises:
        CoopenvError: any of it does not exist or does not fit.
    """
    recorded, cars = {"data": data, "variant": variant, "topics": topics, **selection.given}, cars or {}
    if backend == "svea":
        _refuse(recorded, " is for recorded data, backend='svea' has cars")
        return _open_cars(str(name_or_path), overrides, cars)
    if _is_backend(backend):
        _refuse(
            {**overrides, **cars, **recorded}, f": {type(backend).__name__} has its scenario already, choose it there"
        )
        return backend
    _refuse(cars, ": is for backend='svea'")
    if backend is not None:
        check_one_of("unknown backend", str(backend), BACKENDS)
    if is_recording(name_or_path):
        _refuse({"data": data, "variant": variant, "topics": topics}, " is for files, a Recording was given")
        check_one_of("backend of a Recording", backend or "replay", ("replay",))
        from coopenv.backends.worlds import Replay

        return Replay(selection.applied(name_or_path, OBJECT), OBJECT, overrides)
    if backend in (None, "replay") and is_bag(name_or_path, topics):
        return open_bags([name_or_path], topics, overrides, data, variant, selection)
    _refuse({f"topics {topics}": topics}, f": is for ROS bags, '{name_or_path}' is none")
    if backend == "replay" or (backend is None and is_recorded(name_or_path)):
        return _open_recorded(str(name_or_path), overrides, data, variant, selection)
    _refuse(recorded, f" is for recorded data, '{name_or_path}' is simulated")
    from coopenv.scenario import load_scenario

    scenario = load_scenario(name_or_path, overrides)
    if backend not in (None, scenario.backend):
        raise CoopenvError(f"backend '{backend}': {name_or_path} has backend = \"{scenario.backend}\"")
    return simulation_of(scenario)


def _is_backend(given: str | Backend | None) -> TypeGuard[Backend]:
    if given is None or isinstance(given, str):  # so that names are looked up before the simulation is loaded
        return False
    from coopenv.backends.base import Backend

    return isinstance(given, Backend)


def _refuse(options: Mapping[str, Any], why: str) -> None:
    """Refuse an option that is given, which does not fit; its name and `why` are the error."""
    for name in [name for name, value in options.items() if value is not None]:
        raise CoopenvError(f"{name}{why}")


def _open_recorded(
    name: str, overrides: Mapping[str, Any], data: str | Path | None, variant: str | None, selection: Selection
) -> Backend:
    """Return the replay of a recording, or of a drive of cars."""
    if kind_of(name) is SourceKind.LOG:
        from coopenv.cars.backend.drive import Drive, is_drive

        if is_drive(name):
            _refuse(selection.given, f" is for recordings, {name} is a drive of cars, which --map opens as a bag")
            return Drive(name, overrides)
    from coopenv.backends.worlds import Replay

    return Replay(open_recording(name, data, variant, selection), Path(name).name, overrides)


def _open_cars(name: str, overrides: Mapping[str, Any], given: Mapping[str, Any]) -> Backend:
    """Return the cars of a deployment file: that which is given, or `name` itself."""
    from coopenv.cars.backend.backend import open_svea

    deployment = given.get("deployment")
    if deployment is None and not name.endswith(".toml"):
        raise CoopenvError(f"deployment: needed by backend='svea': the file with the cars that drive {name}")
    environment = None if deployment is None else name
    options = {key: given[key] for key in ("car", "record", "connect") if given.get(key) is not None}
    return open_svea(deployment or name, environment, overrides, **options)


def open_bags(
    names: Sequence[str | Path],
    topics: str | Path | None,
    overrides: Mapping[str, Any] | None = None,
    data: str | Path | None = None,
    variant: str | None = None,
    selection: Selection = WHOLE,
) -> Bag:
    """Return ROS bags of one drive as a backend; arguments and errors as for `open_backend`."""
    where = ", ".join(str(name) for name in names)
    _refuse({"data": data, "variant": variant}, f" is for recorded data sets, {where} is a ROS bag")
    missing = [str(name) for name in names if not Path(name).exists()]
    if missing:
        raise DataError(f"no such bag: {', '.join(missing)}")
    if topics is None:
        raise DataError(f"{where}: a ROS bag, which needs a map of its topics, --map topics.toml (see docs/bags.md)")
    from coopenv.cars.bags.bag import Bag

    return Bag(names, topics, overrides, selection.start or 0.0, selection.until, selection.robots)
