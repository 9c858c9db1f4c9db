"""Whether a recording, from wherever it comes, can be run on: everything that becomes an index, shape or step size."""

import re
from collections.abc import Sequence
from dataclasses import asdict
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import DataError, shown
from coopenv.estimation.validity import are_covariances, are_numbers, are_rotations, are_unit_vectors, everywhere
from coopenv.observers.contract import Setup
from coopenv.observers.recording import Recording, is_due
from coopenv.scenario.base import LARGEST
from coopenv.scenario.randomness import MOST, PARAMETERS
from coopenv.scenario.topology import neighbour_sets, processing_order

SHAPES: dict[str, tuple[str | int, ...]] = {
    "rotation": ("K", "N", 3, 3),
    "translation": ("K", "N", 3),
    "velocity": ("K", "N", 3),
    "angular_velocity": ("K", "N", 3),
    "bearings": ("K", "N", "T", 3),
    "visible": ("K", "N", "T"),
    "landmarks": ("K", "L", 3),
    "inbox_tick": ("K", "N", "N"),
    "due": ("K",),
    "start_rotation": ("N", 3, 3),
    "start_position": ("N", 3),
    "start_covariance": ("N", 6, 6),
    "truth.rotation": ("K", "N", 3, 3),
    "truth.position": ("K", "N", 3),
}
KINDS = {"visible": "b", "due": "b", "inbox_tick": "i"}  # NumPy's kind of the arrays that do not hold floats

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
TICK_LENGTHS_S = (1e-5, 1e3)
LARGEST_PAN = 3.15  # rad, after rounding
MAX_PERIOD_TICKS = 100_000
LEAST_EIGENVALUE = 1e-12  # least eigenvalue of the correlations of an initial estimate


def check_recording(recording: Recording, where: str) -> None:
    """Refuse a recording that contradicts itself or holds what no kernel may read.

    The DataError begins with its name and names the field, and vehicle and tick where it is about them.
    """
    try:
        _check_setups(recording.setups)
        _check_arrays(recording)
        _check_radio(recording)
        _check_start(recording)
        _check_ticks(recording)
        _check_scenario(recording)
        _check_drawn(recording)
    except _RecordingError as error:
        raise DataError(f"{where}: {error}") from None


class _RecordingError(Exception):
    """What is wrong with a recording."""


def _require(condition: Any, message: str) -> None:
    if not condition:
        raise _RecordingError(message)


def _between(name: str, value: Any, low: float, high: float) -> None:
    _require(low <= value <= high, f"{name}: {shown(value)} is not in {low:g} .. {high:g}")


def _check_setups(setups: Sequence[Setup]) -> None:
    _require(setups, "setups: there are none")
    names = setups[0].target_names
    for name in names:
        _require(NAME.fullmatch(name), f"setups: {shown(name)} is no name")
    _require(len(set(names)) == len(names), "setups: two targets have the same name")
    _require(setups[0].landmarks + len(setups) == len(names), "setups: not as many names as landmarks and vehicles")
    for i, setup in enumerate(setups):
        _check_setup(setup, i, setups[0], f"setups.{i}")


def _check_setup(setup: Setup, vehicle: int, first: Setup, where: str) -> None:
    same = (setup.target_names, setup.landmarks, setup.planar) == (first.target_names, first.landmarks, first.planar)
    _require(same, f"{where}: other names, landmarks or plane than the first vehicle's")
    _require(setup.vehicle == vehicle, f"{where}.vehicle: {setup.vehicle} instead of {vehicle}")
    own, targets = setup.landmarks + vehicle, setup.targets.tolist()
    _require(setup.name == setup.target_names[own], f"{where}.name: not the name of target {own}")
    sensible = len(set(targets)) == len(targets) and set(targets) <= set(range(len(setup.target_names))) - {own}
    _require(sensible, f"{where}.targets: not different targets of 0 .. {len(setup.target_names) - 1} without {own}")
    for name in ("lever_arm", "marker"):
        _require(_is_array(getattr(setup, name), (3,)), f"{where}.{name}: not three numbers")
    noise, gains = setup.noise, setup.gains
    for name, value in asdict(noise).items():
        if name not in ("odometry_period", "image_axis"):
            for entry in np.ravel(value):
                _between(f"{where}.noise.{name}", float(entry), 0.0, LARGEST)
    _between(f"{where}.noise.odometry_period", noise.odometry_period, *TICK_LENGTHS_S)
    if noise.image_axis is not None:
        axis = np.array(noise.image_axis, float)
        _require(axis.shape == (3,) and are_unit_vectors(axis), f"{where}.noise.image_axis: not a unit vector")
    for name, least in (("k", 0.5), ("max_turn", 0.0)):
        value = getattr(gains, name)
        _require(least < value <= LARGEST, f"{where}.gains.{name}: {shown(value)} is not in {least:g} .. {LARGEST:g}")
    for name, count in (("q", len(setup.target_names)), ("V", 2), ("P0", 2)):
        values = np.asarray(getattr(gains, name))
        positive = _is_array(values, (count,)) and (values > 0.0).all()
        _require(positive, f"{where}.gains.{name}: not {count} positive numbers")


def _is_array(values: Any, shape: tuple[int, ...]) -> bool:
    array = np.asarray(values)
    return array.shape == shape and array.dtype.kind == "f" and bool(are_numbers(array).all())


def _check_arrays(r: Recording) -> None:
    sizes = {"K": r.ticks, "N": len(r.setups), "T": len(r.setups[0].target_names), "L": r.setups[0].landmarks}
    for name, axes in SHAPES.items():
        array, kind, shape = attrgetter(name)(r), KINDS.get(name, "f"), tuple(sizes.get(str(n), n) for n in axes)
        fits = array.shape == shape and array.dtype.kind == kind
        _require(fits, f"{name}: shape {array.shape} of {array.dtype}, expected {shape} of {kind}")


def _check_radio(r: Recording) -> None:
    N = len(r.setups)
    _require(sorted(r.order) == list(range(N)), f"order: {shown(r.order)} is no order of 0 .. {N - 1}")
    _between("dt", r.dt, *TICK_LENGTHS_S)
    _between("period", r.period, 1, MAX_PERIOD_TICKS)
    _require(r.staleness > 0.0, f"staleness: {r.staleness} is not positive")
    sent, now = r.inbox_tick, np.arange(r.ticks)[:, None, None]
    received = (sent == -1) | ((sent >= 0) & (sent <= now) & (sent % r.period == 0))
    _require_all(r, everywhere(received, 2), "inbox_tick", f"not -1, nor a multiple of the period {r.period} up to now")
    later = np.diff(sent, axis=0, prepend=-1) >= 0
    _require_all(r, everywhere(later, 2), "inbox_tick", "sent before what had been heard")


def _check_start(r: Recording) -> None:
    for i, setup in enumerate(r.setups):
        _require(are_rotations(r.start_rotation[i]), f"start_rotation: of {setup.name} is no rotation")
        _require(are_numbers(r.start_position[i]).all(), f"start_position: of {setup.name} is not finite or too large")
        definite = are_covariances(r.start_covariance[i], LEAST_EIGENVALUE)
        _require(definite, f"start_covariance: of {setup.name} is not symmetric and positive definite")


def _check_drawn(r: Recording) -> None:
    if r.drawn is not None:
        _between("drawn.key", r.drawn.key, 0, 2**64 - 1)
        _between("drawn.episode", r.drawn.episode, 0, 2**32 - 1)
        _require(len(r.drawn.parameters) == len(PARAMETERS), f"drawn.parameters: not {len(PARAMETERS)} numbers")
        for factor in r.drawn.parameters:
            _between("drawn.parameters", factor, 0.0, MOST**3)


def _check_ticks(r: Recording) -> None:
    _require_all(r, are_rotations(r.rotation), "rotation", "not a rotation")
    for name in ("translation", "velocity", "angular_velocity"):
        _require_all(r, everywhere(are_numbers(getattr(r, name)), -1), name, "not finite or too large")
    unseen = everywhere(np.isnan(r.bearings), -1) & ~r.visible
    _require_all(r, everywhere(are_unit_vectors(r.bearings) | unseen, -1), "bearings", "not unit vectors")
    if r.pan is not None:
        fits = r.pan.shape == r.visible.shape[:2] and r.pan.dtype.kind == "f"
        _require(fits, f"pan: shape {r.pan.shape} of {r.pan.dtype}, expected {r.visible.shape[:2]} of f")
        _require_all(r, np.abs(r.pan) <= LARGEST_PAN, "pan", f"not within {LARGEST_PAN} rad")
    _require_all(r, everywhere(are_numbers(r.landmarks), 1, 2), "landmarks", "not finite or too large")
    R, p = r.truth.rotation, r.truth.position
    unknown_R, unknown_p = everywhere(np.isnan(R), -1, -2), everywhere(np.isnan(p), -1)
    _require_all(r, are_rotations(R) | unknown_R, "truth.rotation", "neither a rotation nor unknown (NaN)")
    _require_all(r, everywhere(are_numbers(p), -1) | unknown_p, "truth.position", "neither finite nor unknown (NaN)")


def _require_all(r: Recording, valid: NDArray[np.bool_], field: str, problem: str) -> None:
    """Blame the first tick, and its first vehicle, at which something is not valid: (K, N), or (K,) of everybody."""
    if not valid.all():
        k, *vehicle = np.argwhere(~valid)[0].tolist()
        whose = "".join(f" of {r.setups[i].name}" for i in vehicle)
        raise _RecordingError(f"{field}{whose}, tick {k}: {problem}")


def _check_scenario(r: Recording) -> None:
    """Compare the setups with the scenario, where there is one."""
    if r.scenario is None:
        return
    s, first = r.scenario, r.setups[0]
    same = (list(first.target_names), first.landmarks) == (s.target_names, len(s.landmarks))
    _require(same, "scenario: other landmarks or vehicles than the setups")
    neighbours = neighbour_sets(s)
    for setup, targets in zip(r.setups, neighbours, strict=True):
        _require(setup.targets.tolist() == targets, f"scenario: {setup.name} has other neighbours than in its setup")
    _require((s.action.pan is None) == (r.pan is None), "pan: as in the scenario, cameras turn or they do not")
    rates, staleness = s.rates, np.inf if s.v2x.staleness is None else s.v2x.staleness
    _require(list(r.order) == processing_order(s, neighbours), "scenario: vehicles in another order than recorded")
    _require(r.dt == 1.0 / rates.camera, f"scenario: ticks of {1.0 / rates.camera:g} s, recorded {r.dt:g} s")
    _require((r.period, r.staleness) == (s.v2x.period, staleness), "scenario: another radio than recorded")
    due = is_due(np.arange(r.ticks), min(rates.observer or rates.camera, rates.camera) / rates.camera)
    _require(np.array_equal(r.due, due), "scenario: corrections due at other ticks than recorded")
