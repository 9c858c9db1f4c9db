"""Whether a tick that a source gives can be run on: all that reaches a kernel as index, shape, rotation or time."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.estimation.validity import are_numbers, are_rotations, are_unit_vectors, everywhere
from coopenv.observers.contract import Message, check_message
from coopenv.observers.recording import LARGEST_PAN, SHAPES, Briefing, Sensed

MEASURED = ("rotation", "translation", "velocity", "angular_velocity", "bearings", "visible", "landmarks")
TICK_SHAPES = {name: shape[1:] for name, shape in SHAPES.items() if shape[0] == "K" and name != "due"}
TICK_SHAPES |= dict.fromkeys(("pan", "odometry_age", "bearing_age", "missing", "late"), ("N",))
KINDS = {"visible": "b", "missing": "b", "late": "b", "inbox_tick": "iu"}
"""NumPy's kinds of the arrays that do not hold numbers of any kind."""


def check_tick(tick: Sensed, index: int, briefing: Briefing) -> None:
    """Refuse a tick that is not number `index` or holds what no kernel may read; rows of the missing are not read.

    Raises:
        CoopenvError: one line that names tick, field and vehicle.
    """
    if tick.index != index:
        raise CoopenvError(f"tick {index}: index: got {tick.index!r:.40}")
    first = briefing.setups[0]
    sizes = {"N": len(briefing.setups), "T": len(first.target_names), "L": first.landmarks}
    for problem in _misshapen(tick, sizes):
        raise CoopenvError(f"tick {index}: {problem}")
    for field, valid, problem in _judged(tick):
        if not valid.all():
            whose = f" of {briefing.setups[int(np.argmin(valid))].name}" if valid.ndim else ""
            raise CoopenvError(f"tick {index}: {field}{whose}: {problem}")


def _misshapen(tick: Sensed, sizes: dict[str, int]) -> Iterator[str]:
    for name, letters in TICK_SHAPES.items():
        whole, _, part = name.partition(".")
        value = getattr(tick, whole)
        value = getattr(value, part) if part and value is not None else value
        shape, kinds = tuple(sizes.get(str(n), n) for n in letters), KINDS.get(name, "fiu")
        fits = isinstance(value, np.ndarray) and value.shape == shape and value.dtype.kind in kinds
        if not fits and (value is not None or name in MEASURED):
            got = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
            yield f"{name}: expected an array of shape {shape} and kind {kinds}, got {got}"


def _judged(tick: Sensed) -> Iterator[tuple[str, Any, str]]:
    """Yield (field, whether it is valid, of everybody or (N,), what it is otherwise)."""
    absent = np.zeros(len(tick.rotation), bool) if tick.missing is None else tick.missing
    yield "landmarks", are_numbers(tick.landmarks).all(), "not finite or too large"
    yield "rotation", are_rotations(tick.rotation) | absent, "not a rotation"
    for name in ("translation", "velocity", "angular_velocity"):
        yield name, everywhere(are_numbers(getattr(tick, name)), -1) | absent, "not finite or too large"
    seen = tick.visible & ~absent[:, None]
    yield "bearings", everywhere(are_unit_vectors(tick.bearings) | ~seen, -1), "not unit vectors"
    if tick.pan is not None:
        yield "pan", (np.abs(tick.pan) <= LARGEST_PAN) | absent, f"not within {LARGEST_PAN} rad"
    for name in ("odometry_age", "bearing_age"):
        if (age := getattr(tick, name)) is not None:
            yield name, (age >= 0.0) | absent, "negative or not a number"
    if tick.truth is not None:
        R, p = tick.truth.rotation, tick.truth.position
        unknown = everywhere(np.isnan(R), -1, -2) & everywhere(np.isnan(p), -1)
        known = are_rotations(R) & everywhere(are_numbers(p), -1)
        yield "truth", known | unknown, "neither a pose nor unknown (NaN)"
    if (sent := tick.inbox_tick) is not None:
        yield "inbox_tick", everywhere((sent >= -1) & (sent <= tick.index), -1), "neither -1 nor a tick up to now"
    elif tick.messages:
        yield "messages", np.False_, "where some come from elsewhere, inbox_tick says what became of the others"
    vehicles = np.arange(len(tick.rotation))
    for (receiver, sender), received in tick.messages.items():
        possible = receiver in vehicles and sender in vehicles and receiver != sender
        yield "messages", np.bool_(possible), f"({receiver!r:.20}, {sender!r:.20}) are no two vehicles"
        yield "messages", (vehicles != receiver) | (received.age >= 0.0), "of negative age"


def is_sound(message: Message) -> bool:
    """Return whether a message from elsewhere holds what an inbox may hold."""
    try:
        check_message(message)
    except CoopenvError:
        return False
    turned = message.rotation is None or bool(are_rotations(np.asarray(message.rotation, dtype=float)))
    return turned and (message.position is None or bool(are_numbers(message.position).all()))
