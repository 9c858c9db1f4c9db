"""Mistakes of an observer, found by its answers to the start of a record that is changed.

In turned axes an observer must have the same errors. Bearings and messages must have an effect, and at once. A gate
must keep out bearings that are a right angle off.
"""

from dataclasses import replace

import numpy as np

from coopenv.estimation.metrics import position_std
from coopenv.estimation.poses import Array
from coopenv.observers.contract import Factory
from coopenv.observers.correction import LARGEST
from coopenv.observers.recording import Recording
from coopenv.observers.registry import find
from coopenv.observers.runner import Run, run
from coopenv.observers.sensed import Truth
from coopenv.sources.worlds import stretch

STRETCH, CHANGE = 1.5, 0.5  # s: the length of the changed records, and the latest time of their change
BEFORE = 4  # usable frames before the change: a gate lets much of the first ones pass
EQUAL = 0.03  # relative, of errors in turned axes; those of `ukf` change by 0.016, as its sigma points follow the axes
SMALL = 4.0  # ANEES of a standard deviation that is half the error
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # a right angle about the vertical axis


def findings_on(observer: str | Factory, recording: Recording, result: Run, steady_from: float) -> tuple[str, ...]:
    """Return the mistakes of an observer that ran on a record with this result, steady from a time on, s.

    Joint observers and failed runs are not examined, and neither are records with few frames until the change, or with
    faults of messages or observers.
    """
    if recording.interference is not None or result.failure or getattr(find(observer), "joint", False):
        return ()
    record = stretch(recording, 0, int(np.flatnonzero(recording.t <= STRETCH)[-1]), "record")
    usable = record.visible & record.due[:, None, None]
    usable[..., record.landmarks.shape[1] :] &= record.inbox_tick >= 0
    frames = np.flatnonzero(usable.any(axis=(1, 2)) & (record.t <= CHANGE))
    if len(frames) <= BEFORE:
        return ()
    tick = int(frames[-1])
    errors = ("position_error", "orientation_error", "nees")
    turned = run(observer, _turned(record))
    before, after = (
        [np.nansum(getattr(one, name)[: record.ticks], axis=0) for name in errors] for one in (result, turned)
    )
    found = [] if turned.failure or np.allclose(before, after, rtol=EQUAL, atol=1e-6) else ["wrong frame"]
    bearings, inbox = record.bearings.copy(), record.inbox_tick.copy()
    bearings[tick], inbox[tick:] = bearings[tick] @ QUARTER.T, inbox[tick]
    newer = (record.inbox_tick > inbox) & usable[..., record.landmarks.shape[1] :]
    delay, usable[:tick], usable[tick + 1 :] = 0, False, False
    for name, made, effective in (
        ("bearings", replace(record, bearings=bearings), usable),
        ("messages", replace(record, inbox_tick=inbox), newer),
    ):
        answer = run(observer, made)
        moved = np.linalg.norm(answer.position - result.position[: record.ticks], axis=-1)
        if answer.failure or not effective.any():
            continue
        if not moved.any():
            found.append(f"{name} ignored")
            continue
        first = int(moved.any(axis=1).argmax())
        delay = max(delay, first - int(effective.any(axis=(1, 2)).argmax()))
        if name == "bearings" and _exceeds_gate(record, result, first, moved[first]):
            found.append("no gate")
    if delay:
        found.append(f"stale clock ({delay * record.dt:.2g} s)")
    anees = float(np.nan_to_num(result.anees(steady_from)).min())
    return (f"P {anees:.0f} times too small",) if not found and anees > SMALL else tuple(found)


def _exceeds_gate(record: Recording, result: Run, k: int, moved: Array) -> bool:
    """Return whether wrong bearings moved an estimate (N,) farther, m, than gates allow: a quantile for each target."""
    std = position_std(result.covariance[k], result.coordinates, result.rotation[k], result.position[k])
    prior = np.sqrt(np.trace(record.start_covariance[:, 3:, 3:], axis1=1, axis2=2))
    allowed = np.sqrt(LARGEST * record.visible.sum(axis=2).max(axis=0))
    return bool((moved > allowed * np.where(np.isfinite(std), std, prior)).any())


def _turned(record: Recording) -> Recording:
    """Return a record with the axes of map and bodies turned about the vertical.

    The vehicle with the largest heading gets none, so that even an observer that mixes up body and map uses bearings.
    """
    headings = np.arctan2(record.start_rotation[:, 1, 0], record.start_rotation[:, 0, 0])
    largest = headings[np.abs(headings).argmax()]
    angle = -largest if abs(largest) > 0.5 else np.pi
    c, s = np.cos(angle), np.sin(angle)
    body = np.eye(3) if record.on_a_plane else QUARTER
    Q = body @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    setups = tuple(
        replace(
            setup,
            lever_arm=body @ setup.lever_arm,
            marker=body @ setup.marker,
            optical_axis=tuple(body @ setup.optical_axis),
            noise=replace(setup.noise, image_axis=setup.noise.image_axis and tuple(body @ setup.noise.image_axis)),
        )
        for setup in record.setups
    )
    vectors = ("translation", "velocity", "angular_velocity", "bearings")
    return replace(
        record,
        setups=setups,
        rotation=body @ record.rotation @ body.T,
        **{name: getattr(record, name) @ body.T for name in vectors},
        landmarks=record.landmarks @ Q.T,
        start_rotation=Q @ record.start_rotation @ body.T,
        start_position=record.start_position @ Q.T,
        truth=Truth(Q @ record.truth.rotation @ body.T, record.truth.position @ Q.T),
    )
