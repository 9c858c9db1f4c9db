"""Whether a tick that a source gives can be run on: all that reaches a kernel as index, shape, rotation or time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.errors import CoopenvError
from coopenv.estimation.validity import are_numbers, are_rotations, are_unit_vectors, everywhere
from coopenv.observers.checks import check_message
from coopenv.observers.contract import Message
from coopenv.observers.recording import Briefing, Sensed
from coopenv.observers.recording_checks import SHAPES

MEASURED = ("rotation", "translation", "velocity", "angular_velocity", "bearings", "visible", "landmarks")


def check_tick(tick: Sensed, index: int, briefing: Briefing) -> None:
    """Refuse a tick that is not the expected one or holds what no kernel may read; rows of the missing are not read.

    Args:
        tick: from a source.
        index: of the tick that comes now.
        briefing: of the world.

    Raises:
        CoopenvError: one line that names tick, field and vehicle.
    """
    if tick.index != index:
        raise CoopenvError(f"tick {index}: index: got {tick.index!r:.40}")
    for field, vehicle, problem in _problems(tick, briefing):
        whose = "" if vehicle is None else f" of {briefing.setups[vehicle].name}"
        raise CoopenvError(f"tick {index}: {field}{whose}: {problem}")


def _problems(tick: Sensed, briefing: Briefing) -> Iterator[tuple[str, int | None, str]]:
    first = briefing.setups[0]
    sizes = {"N": len(briefing.setups), "T": len(first.target_names), "L": first.landmarks}
    N = sizes["N"]
    for name in MEASURED:
        yield from _misshapen(name, getattr(tick, name), tuple(sizes.get(str(n), n) for n in SHAPES[name][1:]))
    for name in ("odometry_age", "bearing_age", "missing", "late"):
        yield from _misshapen(name, getattr(tick, name), (N,))
    if tick.truth is not None:
        yield from _misshapen("truth.rotation", tick.truth.rotation, (N, 3, 3))
        yield from _misshapen("truth.position", tick.truth.position, (N, 3))
    yield from _misshapen("inbox_tick", tick.inbox_tick, (N, N))
    if not are_numbers(tick.landmarks).all():
        yield "landmarks", None, "not finite or too large"
    for name, valid, problem in _judged(tick):
        if not valid.all():
            yield name, int(np.argmin(valid)), problem
    yield from _wrong_messages(tick, N)


def _misshapen(name: str, value: Any, shape: tuple[Any, ...]) -> Iterator[tuple[str, int | None, str]]:
    kinds = {"visible": "b", "missing": "b", "late": "b", "inbox_tick": "iu"}.get(name, "fiu")
    if value is not None and not (isinstance(value, np.ndarray) and value.shape == shape and value.dtype.kind in kinds):
        got = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
        yield name, None, f"expected an array of shape {shape} and kind {kinds}, got {got}"


def _judged(tick: Sensed) -> Iterator[tuple[str, NDArray[np.bool_], str]]:
    """Yield (field, (N,) where it is valid, what it is otherwise)."""
    absent = np.zeros(len(tick.rotation), bool) if tick.missing is None else tick.missing
    yield "rotation", are_rotations(tick.rotation) | absent, "not a rotation"
    for name in ("translation", "velocity", "angular_velocity"):
        yield name, everywhere(are_numbers(getattr(tick, name)), -1) | absent, "not finite or too large"
    seen = tick.visible & ~absent[:, None]
    yield "bearings", everywhere(are_unit_vectors(tick.bearings) | ~seen, -1), "not unit vectors"
    for name, age in (("odometry_age", tick.odometry_age), ("bearing_age", tick.bearing_age)):
        if age is not None:
            yield name, (age >= 0.0) | absent, "negative or not a number"
    if tick.truth is not None:
        R, p = tick.truth.rotation, tick.truth.position
        unknown = everywhere(np.isnan(R), -1, -2) & everywhere(np.isnan(p), -1)
        known = are_rotations(R) & everywhere(are_numbers(p), -1)
        yield "truth", known | unknown, "neither a pose nor unknown (NaN)"
    if tick.inbox_tick is not None:
        sent = tick.inbox_tick
        yield "inbox_tick", everywhere((sent >= -1) & (sent <= tick.index), -1), "neither -1 nor a tick up to now"


def _wrong_messages(tick: Sensed, N: int) -> Iterator[tuple[str, int | None, str]]:
    if tick.messages and tick.inbox_tick is None:
        yield "messages", None, "where some come from elsewhere, inbox_tick says what became of the others"
    for (receiver, sender), received in tick.messages.items():
        if not (0 <= receiver < N and 0 <= sender < N and receiver != sender):
            yield "messages", None, f"({receiver!r:.20}, {sender!r:.20}) are no two vehicles"
        if not received.age >= 0.0:
            yield "messages", receiver, "of negative age"


def is_sound(message: Message) -> bool:
    """Return whether a message from elsewhere holds what an inbox may hold."""
    try:
        check_message(message)
    except CoopenvError:
        return False
    turned = message.rotation is None or bool(are_rotations(np.asarray(message.rotation, dtype=float)))
    return turned and (message.position is None or bool(are_numbers(message.position).all()))
