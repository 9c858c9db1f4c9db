"""Changes of a recording by faults of the radio, of bearings, of maps, of odometry and of broadcasts.

No observer knows of a fault. The truth is never changed. Every random draw is a function of the seed and the fault.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.base.fault_text import Fault
from coopenv.scenario import Scenario
from coopenv.scenario.schema import neighbour_sets, processing_order

if TYPE_CHECKING:
    from coopenv.observers.faults import Interference
    from coopenv.observers.recording import Recording

CAMERA = "camera"
"""Name of the camera among the sensors."""
DIRECTION = np.array([0.6, 0.8, 0.0])
"""Direction of a false position, map axes: horizontal, and along no road."""


def with_sensors(recording: Recording, names: Iterable[str]) -> Recording:
    """Keep the measurements of some sensors alone, by their names; the camera's is "camera"."""
    kept, scenario = set(names), recording.scenario
    changes: dict[str, Any] = {
        "setups": tuple(
            replace(setup, sensors=tuple(sensor for sensor in setup.sensors if sensor.name in kept))
            for setup in recording.setups
        ),
        "readings": {name: values for name, values in recording.readings.items() if name in kept},
    }
    if scenario is not None:
        sections = tuple(section for section in scenario.sensors if section.label in kept)
        changes["scenario"] = scenario.model_copy(update={"sensors": sections})
    if CAMERA not in kept:
        changes["visible"] = np.zeros_like(recording.visible)
        changes["bearings"] = np.full_like(recording.bearings, np.nan)
    return replace(recording, **changes)


def amount(recording: Recording, fault: Fault, seed: int) -> np.ndarray:
    """Return (K, N) how large the error of a fault is in each vehicle, by its model (default: a constant one)."""
    since = recording.t - fault.start_in(float(recording.t[-1]))
    begun, passed = since > -1e-6 * recording.dt, np.tile(np.maximum(0.0, since), (len(recording.setups), 1)).T
    course = FAULT_MODELS[fault.word or "offset"](recording, fault, seed, passed)
    return np.asarray(fault.value * course * np.outer(begun, _on(recording, fault)))


def _walked(recording: Recording, fault: Fault, seed: int, passed: np.ndarray) -> np.ndarray:
    """Return random walks (K, N) of variance 1 per second, from the tick after the start on."""
    steps = np.random.default_rng([seed, 10]).standard_normal(passed.shape) * math.sqrt(recording.dt)
    return np.asarray(np.cumsum(steps * (passed > 0.5 * recording.dt), axis=0))


def bursts(recording: Recording, fault: Fault, seed: int, of: Sequence[int], share: float) -> np.ndarray:
    """Return (K, ...) whether an error that comes and goes is there, drawn anew for every burst of each of several."""
    length = max(1, round(fault.options.get("burst", BURST) / recording.dt))
    drawn = np.random.default_rng([seed, 4]).random((math.ceil(recording.ticks / length), *of))
    return np.repeat(drawn < share, length, axis=0)[: recording.ticks]


SHARE, BURST = 0.2, 0.5  # of the time in which an intermittent error is there, and s
FAULT_MODELS: dict[str, Callable[[Recording, Fault, int, np.ndarray], np.ndarray]] = {
    "offset": lambda recording, fault, seed, passed: np.ones_like(passed),
    "ramp": lambda recording, fault, seed, passed: passed / max(float(passed[-1].max()), recording.dt),
    "drift": lambda recording, fault, seed, passed: passed,
    "walk": _walked,
    "intermittent": lambda recording, fault, seed, passed: bursts(
        recording, fault, seed, passed.shape[1:], fault.options.get("share", SHARE)
    ),
}
"""Course (K, N) of an error of size 1, given the time (K, N) since its start, s: constant, growing to the end, growing
every second, walking at random, or there in bursts."""


def with_deliveries(recording: Recording, kept: np.ndarray) -> Recording:
    """Deliver only some messages, by a mask (K, N receiver, N sender) or less; the last received one stays known."""
    inbox = recording.inbox_tick
    news = np.diff(inbox, axis=0, prepend=-1) > 0
    return replace(recording, inbox_tick=np.maximum.accumulate(np.where(news & kept, inbox, -1), axis=0))


def with_loss(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Lose each message, per receiver, with a probability in [0, 1]."""
    drawn = np.random.default_rng([seed, 1]).random(recording.inbox_tick.shape)
    return with_deliveries(recording, drawn >= fault.value)


def with_delay(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Deliver every message later, by a time that is rounded to whole ticks."""
    ticks = min(round(fault.value / recording.dt), recording.ticks)
    inbox = np.full_like(recording.inbox_tick, -1)
    inbox[ticks:] = recording.inbox_tick[: recording.ticks - ticks]
    return replace(recording, inbox_tick=inbox)


def with_wrong_association(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Swap bearings within frames so that a share of all bearings carry the identity of another visible target.

    Every bearing starts a swap with another one of its frame, drawn at random, with half that probability, so that
    it is part of one with (nearly) the whole. A frame with a single bearing stays as it is.
    """
    bearings = recording.bearings.copy()
    generator = np.random.default_rng([seed, 2])
    starts = recording.visible & (generator.random(recording.visible.shape) < fault.value / 2)
    partners = generator.random(recording.visible.shape)
    for k, i, target in np.argwhere(starts):
        others = np.flatnonzero(recording.visible[k, i])
        others = others[others != target]
        if len(others):
            pair = [target, others[int(partners[k, i, target] * len(others))]]
            bearings[k, i, pair] = bearings[k, i, pair[::-1]]
    return replace(recording, bearings=bearings)


def with_random_bearings(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Replace a share of all bearings by uniform directions."""
    bearings = recording.bearings.copy()
    generator = np.random.default_rng(seed)
    wrong = recording.visible & (generator.random(recording.visible.shape) < fault.value)
    directions = generator.standard_normal((int(wrong.sum()), 3))
    bearings[wrong] = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return replace(recording, bearings=bearings)


def with_reflections(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Mirror the bearings to landmarks at a vertical plane along the vehicle's way, in bursts for a share of the time.

    Bursts are drawn per vehicle and landmark.
    """
    N, L = len(recording.setups), recording.landmarks.shape[1]
    reflected = bursts(recording, fault, seed, (N, L), fault.value) & _on(recording, fault)[:, None]
    way = recording.velocity.mean(axis=0)
    size = np.linalg.norm(way[:, :2], axis=-1, keepdims=True)
    ahead = np.where(size > 1e-6, way[:, :2] / np.maximum(size, 1e-6), (1.0, 0.0))
    across = np.stack([-ahead[:, 1], ahead[:, 0], np.zeros(N)], axis=-1)[:, None]  # of the plane, body axes
    bearings = recording.bearings.copy()
    seen = bearings[:, :, :L]
    mirrored = seen - 2.0 * np.sum(seen * across, axis=-1, keepdims=True) * across
    bearings[:, :, :L] = np.where(reflected[..., None], mirrored, seen)
    return replace(recording, bearings=bearings)


def with_late_frames(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Let frames show the bearings of a time before, interpolated between frames; what has none is not measured."""
    frames = np.arange(recording.ticks) - fault.value / recording.dt
    first = np.maximum(np.floor(frames + 1e-9).astype(int), 0)
    share = np.maximum(frames - first, 0.0)[:, None, None, None]
    then, after = (recording.bearings[k] for k in (first, np.minimum(first + 1, recording.ticks - 1)))
    between = np.where(share > 1e-9, (1.0 - share) * then + share * after, then)
    between /= np.linalg.norm(between, axis=-1, keepdims=True)
    bearings = np.where(_on(recording, fault)[:, None, None], between, recording.bearings)
    seen = recording.visible & np.isfinite(bearings).all(axis=-1)
    return replace(recording, visible=seen, bearings=np.where(seen[..., None], bearings, np.nan))


def with_correlated_bearings(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Add a Gauss-Markov error of first order to bearings, drawn per vehicle and target."""
    from scipy.signal import lfilter  # late: `coopenv list variants` imports this module

    time = fault.options.get("time", 1.0)
    kept = math.exp(-recording.dt / time) if time > 0.0 else 0.0
    steps = np.random.default_rng([seed, 5]).standard_normal(recording.bearings.shape)
    steps[1:] *= math.sqrt(1.0 - kept**2)
    error = fault.value * lfilter([1.0], [1.0, -kept], steps, axis=0)
    bearings = recording.bearings + error * _on(recording, fault)[:, None, None]
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    return replace(recording, bearings=bearings)


def with_gyro_error(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Add a bias, rad/s, to the vertical axis of gyros."""
    from coopenv.estimation.poses import about_z  # late: `coopenv list variants` imports this module, and no Numba

    bias = amount(recording, fault, seed)
    angular_velocity = recording.angular_velocity + bias[..., None] * (0.0, 0.0, 1.0)
    rotation = recording.rotation @ about_z(bias * recording.dt)
    return replace(recording, rotation=rotation, angular_velocity=angular_velocity)


def with_camera_error(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Turn cameras on their mountings to the left by an angle, rad."""
    from coopenv.estimation.poses import about_z  # late, as above

    turn = amount(recording, fault, seed)
    bearings = np.where(turn[..., None, None] == 0.0, recording.bearings, recording.bearings @ about_z(turn))
    return replace(recording, bearings=bearings)


def with_focal_error(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Let focal lengths be larger than observers know by a share."""
    share = amount(recording, fault, seed)[..., None, None]
    axes = np.array([setup.optical_axis for setup in recording.setups])[:, None]
    along = np.einsum("knti,nui->knt", recording.bearings, axes)[..., None] * axes
    wider = along + (1.0 + share) * (recording.bearings - along)
    bearings = np.where(share == 0.0, recording.bearings, wider / np.linalg.norm(wider, axis=-1, keepdims=True))
    return replace(recording, bearings=bearings)


def with_scale_error(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Let odometries read too much by a share."""
    scale = 1.0 + amount(recording, fault, seed)[..., None]
    return replace(recording, translation=recording.translation * scale, velocity=recording.velocity * scale)


def with_scale_drift(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Let the scale error of odometries grow linearly from a time on, up to its value at the end."""
    return with_scale_error(recording, replace(fault, word="ramp"), seed)


def with_landmark_error(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Shift one landmark on all maps, drawn or by its number, horizontally by a distance, m."""
    count, generator = recording.landmarks.shape[1], np.random.default_rng([seed, 9])
    mark, angle = generator.integers(count), 2.0 * math.pi * generator.random()
    if (number := int(fault.options.get("landmark", mark + 1))) > count:
        raise CoopenvError(f"fault {fault.text}: landmark: expected a number up to {count}, got {number}")
    landmarks = recording.landmarks.copy()
    shift = amount(recording, fault, seed)[:, :1] * _horizontal(np.array(fault.options.get("angle", angle)))
    landmarks[:, number - 1] += shift
    return replace(recording, landmarks=landmarks)


def without_landmarks(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Hide all landmarks from a time on, for a duration."""
    start = fault.start_in(float(recording.t[-1]))
    lost = (recording.t >= start) & (recording.t < start + fault.duration)
    landmarks = np.arange(recording.visible.shape[2]) < recording.landmarks.shape[1]
    hidden = lost[:, None, None] & landmarks
    bearings = np.where(hidden[..., None], np.nan, recording.bearings)
    return replace(recording, visible=recording.visible & ~hidden, bearings=bearings)


def with_jammer(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Drop messages in the range of jammers, as `[faults.jammer]` of a scenario does.

    Raises:
        CoopenvError: the range is limited and true positions are not known.
    """
    options, position = fault.options, recording.truth.position
    since = (np.arange(recording.ticks) - _first_tick(recording, fault)) * recording.dt + 1e-9
    share = since / options.get("period", 1.0)
    on = (since >= 0.0) & (since < fault.duration) & (share - np.floor(share) < options.get("duty", 1.0))
    jammed = np.broadcast_to(on[:, None], position.shape[:2])
    if fault.value < math.inf:
        if not recording.truth.known.all():
            raise CoopenvError(f"fault {fault.text}: true positions are not known, leave its range out")
        origin = np.zeros(3) if recording.scenario is None else np.array(recording.scenario.map.origin)
        fixed = np.array([[options.get(axis, 0.0) for axis in "xyz"]]) - origin
        sources = position[:, _indices(recording, fault)] if fault.vehicles else fixed[None]
        distance = np.linalg.norm(position[:, :, None] - sources[:, None], axis=-1).min(axis=-1)
        jammed = jammed & (distance <= fault.value)
    return with_deliveries(recording, ~jammed[:, :, None])


def with_prior_error(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Shift initial estimates on the map by a distance; their covariances stay."""
    drawn = np.random.default_rng([seed, 6]).random(len(recording.setups))
    angle = np.broadcast_to(fault.options.get("angle", 2.0 * math.pi * drawn), drawn.shape)
    offset = fault.value * _on(recording, fault)[:, None] * _horizontal(angle)
    return replace(recording, start_position=recording.start_position + offset)


def with_map_error(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Shift landmarks on the vehicles' maps, as `[faults.map_error]` of a scenario does; default: all of both."""
    false, names = _interference(recording), recording.setups[0].target_names
    marks = [names.index(fault.word)] if fault.word else [*range(recording.landmarks.shape[1])]
    drawn = np.random.default_rng([seed, 3]).random((2, recording.landmarks.shape[1]))[:, marks]
    angle = fault.options.get("angle", 2.0 * math.pi * drawn[0])
    offset = fault.value + fault.options.get("spread", 0.0) * drawn[1]
    entries = np.ix_(_indices(recording, fault), marks)
    false.map_error[entries] = offset[:, None] * _horizontal(np.broadcast_to(angle, len(marks)))
    false.map_tick[entries] = _first_tick(recording, fault)
    return replace(recording, interference=false)


def with_map_noise(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Shift every landmark on all maps by a normally distributed error in each axis."""
    shape = recording.landmarks.shape[1:]
    error = fault.value * np.random.default_rng([seed, 7]).standard_normal(shape)
    return replace(recording, landmarks=recording.landmarks + error)


def with_map_exchange(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Exchange the places of two landmarks on all maps, drawn.

    Raises:
        CoopenvError: there is one landmark or none.
    """
    count = recording.landmarks.shape[1]
    if count < 2:
        raise CoopenvError(f"fault {fault.text}: needs two landmarks, there {'is one' if count else 'are none'}")
    pair = np.random.default_rng([seed, 8]).choice(count, 2, replace=False)
    landmarks = recording.landmarks.copy()
    landmarks[:, pair] = landmarks[:, pair[::-1]]
    return replace(recording, landmarks=landmarks)


def _horizontal(angle: np.ndarray) -> np.ndarray:
    """Return (..., 3) the horizontal directions at angles (...) from the map's x axis, rad."""
    return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)


def _indices(recording: Recording, fault: Fault) -> list[int]:
    """Return the vehicles that have a fault; all if none is named."""
    names = [setup.name for setup in recording.setups]
    return [names.index(name) for name in fault.vehicles or names]


def _on(recording: Recording, fault: Fault) -> np.ndarray:
    """Return (N,) which vehicles have a fault."""
    return np.isin(np.arange(len(recording.setups)), _indices(recording, fault))


def _first_tick(recording: Recording, fault: Fault) -> int:
    """Return the first tick of a fault."""
    return math.ceil(fault.start_in(float(recording.t[-1])) / recording.dt - 1e-6)


def _interference(recording: Recording) -> Interference:
    """Return a copy of a recording's interference that may be written to; one without any fault if it has none."""
    from coopenv.observers.faults import Interference

    K, N, L = recording.ticks, len(recording.setups), recording.landmarks.shape[1]
    return deepcopy(recording.interference) or Interference(
        shift=np.zeros((K, N, 3)),
        turn=np.zeros((K, N, 3)),
        std=np.zeros((K, N)),
        replay=np.zeros((K, N), np.int64),
        clock=np.zeros(N, np.int64),
        restarts=np.zeros((K, N), bool),
        kept=np.zeros(N, np.int64),
        consistent=np.zeros(N, bool),
        map_error=np.zeros((N, L, 3)),
        map_tick=np.full((N, L), -1),
    )


def with_lie(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Let vehicles broadcast another pose, as `[faults.lie]` of a scenario does; default: the usual sender."""
    period, false = recording.period, _interference(recording)
    senders = _indices(recording, fault) if fault.vehicles else [usual_sender(recording)]
    since = np.arange(recording.ticks) - _first_tick(recording, fault)
    lying = since >= 0
    direction = _horizontal(np.array(fault.options["angle"])) if "angle" in fault.options else DIRECTION
    for sender in senders:
        if fault.word == "replay":
            false.kept[sender] = period * max(1, round(fault.value / (recording.dt * period)))
            false.replay[lying, sender] = false.kept[sender]
        else:
            size = fault.value * (since * recording.dt if fault.word == "drift" else np.ones(len(since)))
            false.shift[lying, sender] += (size[:, None] * direction)[lying]
            false.turn[lying, sender, 2] += fault.options.get("turn", 0.0)
        false.consistent[sender] = fault.options.get("honest_odometry", 0.0) == 0.0
        if "std" in fault.options:
            false.std[lying, sender] = fault.options["std"]
    return replace(recording, interference=false)


NO_FOLLOWERS = "no vehicle has another one as its neighbour"


def leaders_of(world: Recording | Scenario) -> list[int]:
    """Return the vehicles, in the order of estimation, that another one has as its neighbour."""
    sets: Sequence[Any]
    if isinstance(world, Scenario):
        sets, landmarks = neighbour_sets(world), len(world.landmarks)
        order: Iterable[int] = processing_order(world, sets)
    else:
        sets, landmarks, order = [setup.targets for setup in world.setups], world.setups[0].landmarks, world.order
    return [i for i in order if any(landmarks + i in targets for targets in sets)]


def usual_sender(world: Recording | Scenario) -> int:
    """Return the second vehicle, in the order of estimation, that has followers, or the only one.

    The first one is mostly seen by vehicles that see the landmarks, too.

    Raises:
        CoopenvError: no vehicle has followers.
    """
    leaders = leaders_of(world)
    if not leaders:
        raise CoopenvError(NO_FOLLOWERS)
    return leaders[min(1, len(leaders) - 1)]
