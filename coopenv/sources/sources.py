"""Sources of ticks by name.

A wrong name is an error before any of the simulation is loaded.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

from coopenv.base.errors import CoopenvError, DataError, check_one_of
from coopenv.base.installation import absolute_reference
from coopenv.base.plugins import call, offered
from coopenv.measurements.named import allow
from coopenv.sources.registry import ENVIRONMENT, GROUP, LOG, kind_of, kinds, live_kind
from coopenv.sources.selection import WHOLE, Selection

if TYPE_CHECKING:
    from typing_extensions import TypeIs

    from coopenv.observers.recording import Recording
    from coopenv.scenario import Scenario, ScenarioLike
    from coopenv.sources.base import Backend
    from coopenv.sources.worlds import Simulated


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


def open_recording(
    name: str | Path,
    data: str | Path | None = None,
    variant: str | None = None,
    selection: Selection = WHOLE,
) -> Recording:
    """Read a recording.

    Args:
        name: path of an MCAP file, or of a data set: `mrclam_1` .. `mrclam_9`, with `_space` for observers in space.
        data: folder of the data sets (None: that of COOPENV_DATA).
        variant: of a data set: "landmarks", "landmarks+robots" (as recorded, the default) or "blind".
        selection: the part that is used.

    Raises:
        CoopenvError: no such recording or variant, or the file is not what it should be.
    """
    kind = kind_of(name)
    if kind.reader:
        return selection.applied(call(kind.reader, name, data, variant), str(name))
    if kind.recorded:
        given = " --map topics.toml" if "topics" in kind.options else ""
        command = f"{kind.conversion} {name}{given} --out FILE.mcap"
        raise DataError(f"{name}: {kind.title}; make a recording of it with: {command}")
    known = [kind.example for kind in (LOG, *kinds().values()) if kind.example]
    raise DataError(f"'{name}' is no recording; known: {', '.join(known)}")


def read_log(name: str | Path, data: str | Path | None, variant: str | None) -> Recording:
    """Return the recording in an MCAP file; `data` is not read. Raises CoopenvError: it is none, or has no variants."""
    if variant is not None:
        raise DataError(f"{name}: a file has no variants, got variant '{variant}'")
    from coopenv.sources.mcap import read_recording

    return read_recording(name)


OWN_KIND = re.compile(r"sensors\.(\w+)\.kind")
"""Override of a recording that names the class of one of its sensors."""


def allow_kinds(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Let recordings name the classes of sensors that overrides name, and return the other overrides."""
    rest = dict(overrides)
    for key in [key for key in overrides if OWN_KIND.fullmatch(key)]:
        allow(absolute_reference(str(rest.pop(key))))
    return rest


def replay_of(
    name: str,
    overrides: Mapping[str, Any],
    data: str | Path | None = None,
    variant: str | None = None,
    selection: Selection = WHOLE,
) -> Backend:
    """Return the replay of a recording by its name; arguments and errors as for `open_recording`."""
    from coopenv.sources.worlds import Replay

    rest = allow_kinds(overrides)
    recording = open_recording(name, data, variant, selection)
    sensors = {sensor.name for setup in recording.setups for sensor in setup.sensors}
    for named in filter(None, map(OWN_KIND.fullmatch, overrides)):
        check_one_of(f"{name}: {named[0]}: unknown sensor", named[1], sorted(sensors))
    return Replay(recording, Path(name).name, rest)


def open_simulation(name_or_path: ScenarioLike, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """Return the scenario of an environment that is to be simulated in many worlds.

    Raises:
        CoopenvError: there is none of that name, or it is of another kind, or an override is not valid.
    """
    kind = kind_of(name_or_path)
    if kind is not ENVIRONMENT:
        what, how = ("recorded", "replay") if kind.recorded else (kind.title, "open")
        raise CoopenvError(f"'{name_or_path}' is {what}, which is one world: {how} it with parallel_env")
    from coopenv.scenario import load_scenario

    return load_scenario(name_or_path, overrides)


def simulation_of(scenario: Scenario) -> Simulated:
    """Return the simulation of a scenario, by its key `backend`.

    Raises:
        CoopenvError: an extra is missing, or the section of the backend is not valid.
    """
    if scenario.cosimulator is not None:
        from coopenv.sources.cosimulation import Cosimulated

        return Cosimulated(scenario)
    if scenario.sensing in offered(GROUP):
        made: Simulated = call(kinds(scenario.sensing)[scenario.sensing].simulation, scenario)
        return made
    from coopenv.scenario.schema import own_drives

    if own_drives(scenario):
        from coopenv.sources.own_drives import OwnDriven

        return OwnDriven(scenario)
    from coopenv.sources.worlds import Simulated

    return Simulated(scenario)


def open_backend(
    name_or_path: ScenarioLike | Recording,
    backend: str | Backend | None,
    overrides: Mapping[str, Any],
    selection: Selection = WHOLE,
    **options: Any,
) -> Backend:
    """Return the source of ticks of an environment or a recording.

    Args:
        name_or_path: what `load_scenario` takes, a `Recording`, or a name that a kind of source claims, see `kind_of`.
        backend: "simulated", a co-simulator, "replay" or a kind that is not recorded; None: by the name; a
            backend itself is returned as it is.
        overrides: dotted scenario keys.
        selection: the part of recorded data that is used.
        options: of kinds by name (`SourceKind.options`), such as `data` and `variant` of data sets, `topics` of ROS
            bags, `deployment`, `car`, `record` and `connect` of cars; None: not given.

    Raises:
        CoopenvError: any of it does not exist or does not fit.
    """
    given = {name: value for name, value in options.items() if value is not None}
    if _is_backend(backend):
        for name in {**overrides, **given, **selection.given}:
            raise CoopenvError(f"{name}: {type(backend).__name__} has its scenario already, choose it there")
        return backend
    if is_recording(name_or_path):
        for name in given:
            raise CoopenvError(f"{name} is for files, a Recording was given")
        check_one_of("backend of a Recording", backend or "replay", ("replay",))
        from coopenv.sources.worlds import Replay

        return Replay(selection.applied(name_or_path, OBJECT), OBJECT, overrides)
    kind = kind_of(name_or_path, given.get("topics"))
    if backend == "replay":
        kind = kind if kind.recorded else LOG
    elif backend is not None:
        from coopenv.scenario.cosimulators import COSIMULATORS

        kind = live_kind(
            str(backend), {"simulated": ENVIRONMENT, **dict.fromkeys(COSIMULATORS, ENVIRONMENT), "replay": LOG}
        )
        given |= {"backend": backend} if kind is ENVIRONMENT else {}
    return kind.open(name_or_path, overrides, given, selection)


def open_environment(name_or_path: ScenarioLike, overrides: Mapping[str, Any], backend: str | None = None) -> Simulated:
    """Return the simulation of an environment; `backend` is the expected one. Raises CoopenvError: it is another."""
    from coopenv.scenario import load_scenario

    scenario = load_scenario(name_or_path, overrides)
    if backend not in (None, scenario.backend):
        raise CoopenvError(f"backend '{backend}': {name_or_path} has backend = \"{scenario.backend}\"")
    return simulation_of(scenario)


def _is_backend(given: str | Backend | None) -> TypeGuard[Backend]:
    if given is None or isinstance(given, str):  # so that names are looked up before the simulation is loaded
        return False
    from coopenv.sources.base import Backend

    return isinstance(given, Backend)
