"""What moves in the scene: frames, lines of sight, landmarks on the move, and how sure each vehicle is of its place."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from foxglove import messages as fox

from coopenv.estimation.arrays import Array
from coopenv.estimation.map_covariance import covariance_in_map
from coopenv.viz.foxglove.scene import landmark, moving_landmarks
from coopenv.viz.foxglove.shown import MAP, Shown, colour_of, point, pose, quaternion, vector
from coopenv.viz.topview_geometry import SIGMAS

_LARGEST = 2.0  # of the scene's extent: wider ellipsoids would hide it
_UNSEEN = 5.0  # m, length of a line to a target whose place is not known


def transforms(shown: Shown) -> Iterator[tuple[int, bytes]]:
    """Yield the frames of bodies, true and estimated, and of cameras."""
    r, run = shown.recording, shown.run
    for k in shown.ticks:
        found = []
        for i, name in enumerate(shown.names):
            found += _frame(shown, k, MAP, name, r.truth.rotation[k, i], r.truth.position[k, i])
            found += _frame(shown, k, MAP, shown.estimate_frame(i), run.rotation[k, i], run.position[k, i])
            camera = shown.camera(i)
            if camera is not None and (k == 0 or r.pan is not None):
                place = np.array(camera.position)
                found += _frame(shown, k, shown.frame(i), f"{name}/camera", shown.optical(k, i), place)
        yield k, fox.FrameTransforms(transforms=found).encode()


def _frame(shown: Shown, k: int, parent: str, child: str, rotation: Array, place: Array) -> list[Any]:
    if not (np.isfinite(rotation).all() and np.isfinite(place).all()):
        return []
    turned, moved = quaternion(rotation), vector(place)
    names = {"parent_frame_id": parent, "child_frame_id": child}
    return [fox.FrameTransform(timestamp=shown.stamp(k), translation=moved, rotation=turned, **names)]


def sight(shown: Shown) -> Iterator[tuple[int, bytes]]:
    """Yield lines from every camera to the targets that it sees, in the colour of the vehicle."""
    for k in shown.ticks:
        entities = []
        for i, name in enumerate(shown.names):
            ends = _lines(shown, k, i)
            lines = fox.LinePrimitive(
                type=fox.LinePrimitiveLineType.LineList,
                pose=pose(),
                thickness=1.5,
                scale_invariant=True,
                points=[point(end) for end in ends],
                color=colour_of(i, 0.8),
            )
            named = {"timestamp": shown.stamp(k), "frame_id": MAP, "id": f"sight of {name}"}
            entities.append(fox.SceneEntity(lines=[lines] if len(ends) else [], **named))
        yield k, fox.SceneUpdate(entities=entities).encode()


def _lines(shown: Shown, k: int, i: int) -> Array:
    """Return the ends (2m, 3) of the lines of sight of one vehicle, m."""
    here, r = shown.pose(k, i), shown.recording
    if here is None:
        return np.empty((0, 3))
    R, p = here
    origin = p + R @ r.setups[i].lever_arm
    ends = []
    for target in np.flatnonzero(r.visible[k, i]):
        place = _place(shown, k, int(target))
        if place is None:
            place = origin + _UNSEEN * (R @ r.bearings[k, i, target])
        ends += [origin, place]
    return np.array(ends).reshape(-1, 3)


def _place(shown: Shown, k: int, target: int) -> Array | None:
    """Return where a target's marker is, m, None where nobody knows."""
    r, L = shown.recording, shown.recording.landmarks.shape[1]
    if target < L:
        return np.asarray(r.landmarks[k, target])
    there = shown.pose(k, target - L)
    return None if there is None else there[1] + there[0] @ r.setups[target - L].marker


def landmarks(shown: Shown) -> Iterator[tuple[int, bytes]]:
    """Yield the landmarks that move."""
    moving = moving_landmarks(shown).tolist()
    for k in shown.ticks if moving else ():
        yield k, fox.SceneUpdate(entities=[landmark(shown, k, i) for i in moving]).encode()


def uncertainty(shown: Shown, size: float) -> Iterator[tuple[int, bytes]]:
    """Yield ellipsoids of 3 sigma about the estimated places; `size` is the scene's extent, m."""
    run = shown.run
    P = covariance_in_map(run.coordinates, run.rotation, run.position, run.covariance)[..., :3, :3]
    for k in shown.ticks:
        entities, gone = [], []
        for i, name in enumerate(shown.names):
            half, axes = ellipsoid(P[k, i])
            if not (np.isfinite(run.position[k, i]).all() and np.isfinite(half).all() and half.max() < _LARGEST * size):
                gone.append(fox.SceneEntityDeletion(timestamp=shown.stamp(k), id=f"3 sigma of {name}"))
                continue
            place = pose(run.position[k, i], axes)
            ball = fox.SpherePrimitive(pose=place, size=vector(2.0 * half), color=colour_of(i, 0.25))
            named = {"timestamp": shown.stamp(k), "frame_id": MAP, "id": f"3 sigma of {name}"}
            entities.append(fox.SceneEntity(spheres=[ball], **named))
        yield k, fox.SceneUpdate(entities=entities, deletions=gone).encode()


def ellipsoid(covariance: Array) -> tuple[Array, Array]:
    """Return half lengths (3,) of 3 sigma, m, and axes (3, 3), a rotation, of a covariance (3, 3); NaN: it is none."""
    if not np.isfinite(covariance).all():
        return np.full(3, np.nan), np.eye(3)
    variance, axes = np.linalg.eigh((covariance + covariance.T) / 2)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return np.where(variance >= 0, SIGMAS * np.sqrt(np.maximum(variance, 0.0)), np.nan), axes
