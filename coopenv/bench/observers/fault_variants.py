"""Variants with faults that have parameters: what `--fault` asks for, checked against an environment.

    FAULT = PART[+PART...]                                several faults in one variant
    PART  = NAME=VALUE[@VEHICLE[:VEHICLE...]][,OPTION=VALUE...]

For example `lie=drift:0.05@vehicle_2,from=10` or `gyro_bias=0.0175+odometry_scale=0.05`.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from coopenv.base.errors import CoopenvError, listed, shown, suggest
from coopenv.bench.observers.faults import LIE_STD, Lie, liar, with_delay, with_loss, with_wrong_association
from coopenv.bench.observers.faults import without_landmarks as landmarks_lost
from coopenv.observers.recording import Recording
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.starts import neighbour_sets, processing_order

GRAMMAR = "NAME=VALUE[@VEHICLE[:VEHICLE...]][,OPTION=VALUE...], several of them with + between"


@dataclass(frozen=True)
class Part:
    """One fault as it is written."""

    where: str
    """The beginning of an error about it."""
    name: str
    value: str
    who: tuple[str, ...]
    """Names of vehicles; empty: left to the fault."""
    options: dict[str, float]

    @property
    def amount(self) -> float:
        """The value as a number.

        Raises:
            CoopenvError: it is none.
        """
        return number(self.value, f"{self.where}: {self.name}")


def parts_of(text: str) -> tuple[Part, ...]:
    """Read the faults of one variant.

    Raises:
        CoopenvError: it is not written as the grammar says.
    """
    where = f"--fault {text}"
    return tuple(_part(word, where) for word in re.split(r"\+(?=[A-Za-z_])", text.strip()))


def number(text: str, where: str) -> float:
    """Return a finite number that is not negative.

    Raises:
        CoopenvError: it is none.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value < math.inf:
        raise CoopenvError(f"{where}: expected a number from 0 on, got {shown(text)}")
    return value


def _part(text: str, where: str) -> Part:
    first, *more = text.split(",")
    name, equals, rest = first.partition("=")
    value, at, who = rest.partition("@")
    if not (name and equals and value) or (at and not all(who.split(":"))):
        raise CoopenvError(f"{where}: expected {GRAMMAR}")
    options = {}
    for word in more:
        key, equals, given = word.partition("=")
        if not equals:
            raise CoopenvError(f"{where}: {shown(word)} is no OPTION=VALUE")
        options[key] = number(given, f"{where}: {key}")
    return Part(where, name, value, tuple(who.split(":")) if at else (), options)


LIE_AMOUNTS = {"jump": "offset", "drift": "speed", "replay": "age", "collude": "offset"}
"""Kinds of `[faults.lie]`, each with its key that says how much."""
START = {"from": "start"}
HORIZONTAL = [0.6, 0.8, 0.0]  # a direction that no road has


@dataclass(frozen=True)
class Knob:
    """A fault that has a value."""

    value: str
    """What the value is, in capitals, and its unit."""
    about: str
    keys: Callable[[Part], dict[str, Any]] | None = None
    """Keys of a vehicle in the scenario: only simulated environments have such."""
    change: Callable[[Recording, Part, int], Recording] | None = None
    """(recording, part, seed) -> recording: for recorded logs, too."""
    lie: Callable[[Recording, Part], Lie] | None = None
    options: tuple[str, ...] = ()
    of_one: bool = False
    """Of the usual liar, unless vehicles are named; False: of everybody."""
    most: float = float("inf")
    """The largest value, where it is a number."""


def _keys(section: str, key: str, options: Mapping[str, str] | None = None) -> Callable[[Part], dict[str, Any]]:
    """Return how a number becomes a key of a section of a vehicle, and options others, by name."""
    names = dict(options or {})

    def keys(part: Part) -> dict[str, Any]:
        given = {names[option]: value for option, value in part.options.items()}
        return {section: {key: part.amount, **given}}

    return keys


def _lie(part: Part) -> dict[str, Any]:
    kind, colon, amount = part.value.partition(":")
    if kind not in LIE_AMOUNTS:
        raise CoopenvError(
            f"{part.where}: unknown lie '{kind}'{suggest(kind, LIE_AMOUNTS)}; known: {listed(list(LIE_AMOUNTS))}"
        )
    lie: dict[str, Any] = {"kind": kind, "direction": HORIZONTAL}
    if colon:
        lie[LIE_AMOUNTS[kind]] = number(amount, f"{part.where}: lie")
    if kind == "collude" and len(part.who) < 2:
        raise CoopenvError(f"{part.where}: it takes two to collude, such as lie=collude:5@vehicle_2:vehicle_3")
    names = {"from": "start", "std": "std"}
    return {"faults.lie": lie | {names[option]: value for option, value in part.options.items()}}


def _restart(part: Part) -> dict[str, Any]:
    return {"faults.restart": {"chance": 1.0, "time": part.amount, "time_spread": part.options.get("spread", 0.0)}}


def _lying(recording: Recording, part: Part) -> Lie:
    names = [setup.name for setup in recording.setups]
    who = names.index(part.who[0]) if part.who else liar(recording)
    offset = tuple(part.amount * x for x in HORIZONTAL)
    return Lie(who, part.options.get("from", 0.0), (offset[0], offset[1], offset[2]), part.options.get("std", LIE_STD))


KNOBS: dict[str, Knob] = {
    "v2x_loss": Knob(
        "SHARE", "of the messages is lost", change=lambda r, p, seed: with_loss(r, p.amount, seed), most=1.0
    ),
    "v2x_delay": Knob("SECONDS", "by which messages arrive later", change=lambda r, p, seed: with_delay(r, p.amount)),
    "wrong_association": Knob(
        "SHARE",
        "of the bearings carries the identity of another target in view",
        change=lambda r, p, seed: with_wrong_association(r, p.amount, seed),
        most=1.0,
    ),
    "landmarks_lost": Knob(
        "SECONDS",
        "for which no landmark is seen",
        change=lambda r, p, seed: landmarks_lost(r, p.options.get("from"), p.amount),
        options=("from",),
    ),
    "lying_neighbour": Knob(
        "METRES",
        "by which the position that a vehicle broadcasts is off, sure of it to std (0.01 m)",
        lie=_lying,
        options=("from", "std"),
        of_one=True,
    ),
    "odometry_scale": Knob("STD", "of the odometry's scale error", _keys("noise", "odometry_scale")),
    "gyro_bias": Knob("STD", "of the gyro's bias per axis, rad/s", _keys("noise", "gyro_bias")),
    "slip": Knob(
        "RATE",
        "at which wheels begin to slip, 1/s",
        _keys("noise.slip", "rate", {"duration": "duration", "size": "size", "angle": "angle"}),
        options=("duration", "size", "angle"),
    ),
    "extrinsics": Knob(
        "STD",
        "per axis of the rotation of the true camera against the nominal one, rad; position: likewise, m",
        _keys("camera", "extrinsics_error", {"position": "extrinsics_position_error"}),
        options=("position",),
    ),
    "focal_length": Knob("STD", "of the focal length's error, relative", _keys("camera", "focal_length_error")),
    "clock": Knob("STD", "of the clocks' offset, s", _keys("faults", "clock_offset")),
    "restart": Knob(
        "SECONDS", "at which a vehicle's observer loses all and starts anew", _restart, options=("spread",), of_one=True
    ),
    "corruption": Knob(
        "CHANCE",
        "of each message to have its pose altered on the way",
        _keys("faults.corruption", "probability", {**START, "size": "size", "turn": "turn"}),
        options=("from", "size", "turn"),
        most=1.0,
    ),
    "lie": Knob(
        "KIND[:AMOUNT]",
        "jump or collude (m), drift (m/s), replay (s): what a vehicle broadcasts in place of its pose",
        _lie,
        options=("from", "std"),
        of_one=True,
    ),
}
"""By the name on the command line."""


def knob_of(part: Part) -> Knob:
    """Return what a part means.

    Raises:
        CoopenvError: there is no such fault, or it has no such option, or its value is too large.
    """
    knob = KNOBS.get(part.name)
    if knob is None:
        raise CoopenvError(
            f"{part.where}: unknown fault '{part.name}'{suggest(part.name, KNOBS)}; known: {listed(list(KNOBS))}"
        )
    for option in part.options:
        if option not in knob.options:
            allowed = listed(knob.options) if knob.options else "none"
            raise CoopenvError(f"{part.where}: {part.name} has no option '{option}'; allowed: {allowed}")
    if part.who and knob.change is not None:
        raise CoopenvError(f"{part.where}: {part.name} is of everybody; leave out @{':'.join(part.who)}")
    if knob.lie is not None and len(part.who) > 1:
        raise CoopenvError(f"{part.where}: {part.name} is of one vehicle; `lie=jump` may be of several")
    if part.name != "lie" and part.amount > knob.most:
        raise CoopenvError(f"{part.where}: {part.name}: expected {knob.value} in 0 .. {knob.most:g}")
    return knob


@dataclass(frozen=True)
class FaultVariant:
    """One variant: as it is written, and what it does; small enough to travel to a worker."""

    name: str
    parts: tuple[Part, ...]
    scenario: Scenario | None = None
    """The world with those faults that are keys of a scenario; None: there are none."""

    @property
    def summary(self) -> str:
        """What it is, in words."""
        return "; ".join(_in_words(part) for part in self.parts)

    @property
    def lies(self) -> bool:
        """Whether it needs somebody who is listened to."""
        return any(knob_of(part).lie is not None for part in self.parts)

    def applied(self, recording: Recording, seed: int) -> tuple[Recording, Lie | None]:
        """Return the changed record, and the lie for `runner.run`; `recording` is of the variant's scenario."""
        lie = None
        for part in self.parts:
            knob = knob_of(part)
            if knob.change is not None:
                recording = knob.change(recording, part, seed)
            if knob.lie is not None:
                lie = knob.lie(recording, part)
        return recording, lie


def variants_with(faults: Iterable[str]) -> tuple[FaultVariant, ...]:
    """Read faults, one variant each.

    Raises:
        CoopenvError: one is not written as it has to be, or there is no such fault.
    """
    made = tuple(FaultVariant(text.strip(), parts_of(text)) for text in dict.fromkeys(faults))
    for variant in made:
        if sum(knob_of(part).lie is not None for part in variant.parts) > 1:
            raise CoopenvError(f"--fault {variant.name}: one lying_neighbour at most; `lie=jump` may be of several")
    return made


def with_world(variant: FaultVariant, text: str, scenario: Scenario, overrides: Mapping[str, Any]) -> FaultVariant:
    """Return a variant with the world that has its faults, where any is of the world.

    Args:
        variant: which one.
        text: name or file of the environment.
        scenario: the environment with its overrides.
        overrides: these.

    Raises:
        CoopenvError: as for `overrides_of`, or a value is not possible.
    """
    keys = overrides_of(variant, scenario)
    return replace(variant, scenario=load_scenario(text, {**overrides, **keys})) if keys else variant


def overrides_of(variant: FaultVariant, scenario: Scenario) -> dict[str, Any]:
    """Return the dotted keys of a scenario that realise a variant's faults.

    Raises:
        CoopenvError: no such vehicle, or nobody to lie to, or errors of sensors without noise.
    """
    found: dict[str, Any] = {}
    for part in variant.parts:
        keys = knob_of(part).keys
        check_vehicles(part, scenario.vehicle_names)
        for section, values in ({} if keys is None else keys(part)).items():
            for name in _who(part, scenario):
                if section.partition(".")[0] in ("noise", "camera") and not _noisy(scenario, name):
                    raise CoopenvError(f"{part.where}: {part.name} needs noise.enabled = true, which is off")
                found |= {f"vehicles.{name}.{section}.{key}": value for key, value in values.items()}
    return found


def check_vehicles(part: Part, names: list[str]) -> None:
    """Refuse vehicles that there are not. Raises CoopenvError: one that names those that there are."""
    for name in part.who:
        if name not in names:
            raise CoopenvError(
                f"{part.where}: unknown vehicle '{name}'{suggest(name, names)}; there are {listed(names)}"
            )


def check_recorded(variant: FaultVariant, recording: Recording) -> None:
    """Refuse what a record that is already there cannot have. Raises CoopenvError."""
    for part in variant.parts:
        if knob_of(part).keys is not None:
            raise CoopenvError(f"{part.where}: {part.name} is a fault of a simulated world, this one is recorded")
        check_vehicles(part, [setup.name for setup in recording.setups])


def _who(part: Part, scenario: Scenario) -> tuple[str, ...]:
    """Return the names of the vehicles that have a fault."""
    names = scenario.vehicle_names
    if part.who or not knob_of(part).of_one:
        return part.who or tuple(names)
    sets, L = neighbour_sets(scenario), len(scenario.landmarks)
    leaders = [i for i in processing_order(scenario, sets) if any(L + i in targets for targets in sets)]
    if not leaders:
        raise CoopenvError(f"{part.where}: no vehicle has another one as its neighbour; name one, {part.name}=...@NAME")
    return (names[leaders[min(1, len(leaders) - 1)]],)


def _noisy(scenario: Scenario, name: str) -> bool:
    return scenario.noises[scenario.vehicle_names.index(name)].enabled


def _in_words(part: Part) -> str:
    knob = knob_of(part)
    whose = f" ({', '.join(part.who)})" if part.who else ""
    more = "".join(f", {key} {value:g}" for key, value in part.options.items())
    return f"{part.name} {part.value}{more}: {knob.value.lower()} {knob.about}{whose}"
