"""Faults with parameters, by name: keys of the scenario, realised by the world, or changes of a record."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from coopenv.base.errors import CoopenvError, listed, suggest
from coopenv.bench.observers.fault_grammar import Part, number
from coopenv.bench.observers.faults import LIE_STD, Lie, liar, with_delay, with_loss, with_wrong_association
from coopenv.bench.observers.faults import without_landmarks as landmarks_lost
from coopenv.observers.recording import Recording

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
