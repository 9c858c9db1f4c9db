"""Properties of viser's handles, given to viser only where they have changed: most of what is drawn stays as it was."""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.viz.scene import Frame, Source, Stage
from coopenv.viz.style import DARK_BLUE
from coopenv.viz.topview_geometry import semi_axes
from coopenv.viz.topview_ground import TRAFFIC
from coopenv.viz.web.ground import ROOT, Ground, Look, Mesh, arrow, box, car, linear, pole, rgb, sphere


class SentProperties:
    """A handle of viser, and the properties that were sent to it last."""

    def __init__(self, handle: Any) -> None:
        """Start with a new handle."""
        self.handle = handle
        """viser's."""
        self._last: dict[str, Any] = {}

    def set(self, **properties: Any) -> None:
        """Set properties; an array that is given must not be changed afterwards."""
        for name, value in properties.items():
            last = self._last.get(name)
            if isinstance(value, np.ndarray):
                if last is value or (last is not None and np.array_equal(last, value)):
                    continue
            elif last == value:
                continue
            self._last[name] = value
            setattr(self.handle, name, value)


_FINE_TURN = 2.0**-11


class Placed(NamedTuple):
    """Where copies are; those that are not there have size zero."""

    wxyzs: np.ndarray  # (N, 4)
    positions: np.ndarray  # (N, 3) m
    scales: np.ndarray  # (N, 3) m


def placed(rotation: np.ndarray | None, position: np.ndarray, scale: np.ndarray, turn: float = _FINE_TURN) -> Placed:
    """Return copies at positions (N, 3) with rotations (N, 3, 3; None: upright) and sizes (N, 3), NaN: not there.

    Quaternions are given in steps of `turn`.
    """
    good = np.isfinite(position).all(axis=1) & np.isfinite(scale).all(axis=1)
    if rotation is None:
        turned = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(position), 1))
    else:
        good &= np.isfinite(rotation).all(axis=(1, 2))
        whole = Rotation.from_matrix(np.where(good[:, None, None], rotation, np.eye(3)))
        turned = fine(whole.as_quat(canonical=True, scalar_first=True), turn)
    there = good[:, None]
    return Placed(
        turned, np.where(there, position, 0.0).astype(np.float32), np.where(there, scale, 0.0).astype(np.float32)
    )


def fine(values: np.ndarray, step: float) -> np.ndarray:
    """Return values in whole steps, in single precision: a file of them can be packed better."""
    return (np.round(np.asarray(values, float) / step) * step).astype(np.float32)


class Batch:
    """A node with copies of a mesh."""

    def __init__(self, scene: Any, name: str, mesh: Mesh, colours: np.ndarray, **look: Any) -> None:
        """Add them, one per colour (N, 3), to be placed; of none there is no node."""
        count = len(colours)
        self._node: SentProperties | None = None
        if count:
            handle = scene.add_batched_meshes_simple(
                name,
                *mesh,
                np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
                np.zeros((count, 3)),
                batched_scales=np.zeros((count, 3)),
                batched_colors=linear(colours),
                lod="off",
                **{"cast_shadow": False, "receive_shadow": False, **look},
            )
            self._node = SentProperties(handle)

    @property
    def handle(self) -> Any:
        """Viser's handle; None: there is no node."""
        return None if self._node is None else self._node.handle

    def put(self, places: Placed, shown: bool = True) -> None:
        """Put the copies to their places."""
        if self._node is None:
            return
        self._node.set(visible=shown)
        if shown:
            wxyzs, positions, scales = places
            self._node.set(batched_wxyzs=wxyzs, batched_positions=positions, batched_scales=scales)


_SHELL = 1.08  # size of an estimate: around the true vehicle, so that both are seen where they agree
_LARGEST = 0.5  # of the scene's side, largest semi-axis of an ellipsoid that is drawn
_HONEST, _GAIN = 0.2, 0.08  # opacity of an ellipsoid: of a covariance, of a matrix of gains
_STEPS, _TURN = 32, 2.0**-9  # of an ellipsoid: sizes in a doubling, and steps of its quaternion
_DOT = 0.008  # of the scene's side, radius of a landmark
_FAR = 2.0  # scene's sides from its middle: estimates farther away are drawn there


class Actors:
    """Everything that moves but lines."""

    def __init__(self, scene: Any, stage: Stage, source: Source, ground: Ground, colours: np.ndarray) -> None:
        """Add the nodes."""
        self._stage, self._ground, self._colours = stage, ground, colours
        self._step = 2.0 ** np.floor(np.log2(stage.side * 1e-4))
        size, center = stage.bodies
        self._size, self._center = size, center
        white = np.full((stage.vehicles, 3), 255, np.uint8)
        self.cars = Batch(scene, f"{ROOT}/cars/true", car(), colours, flat_shading=True)
        self._arrows = Batch(scene, f"{ROOT}/cars/front", arrow(), white, side="double")
        ghost: dict[str, Any] = {"opacity": 0.32, "flat_shading": True}
        self._ghosts = Batch(scene, f"{ROOT}/estimates/body", car(), colours, **ghost)
        self._frames = Batch(scene, f"{ROOT}/estimates/edges", box(), colours, wireframe=True, opacity=0.5)
        self._ellipsoids = Batch(scene, f"{ROOT}/ellipsoids", sphere(), colours, opacity=_HONEST)
        self.set_source(source)
        dark = np.tile(np.array(rgb(DARK_BLUE), np.uint8), (stage.landmarks, 1))
        self._dots = Batch(scene, f"{ROOT}/landmarks/dots", sphere(6), dark)
        self._poles = Batch(scene, f"{ROOT}/landmarks/poles", pole(), dark)
        self._bodies = [i for i, landmark in enumerate(stage.scenario.landmarks) if landmark.body]
        self._boxes = Batch(scene, f"{ROOT}/landmarks/bodies", box(), dark[self._bodies])
        self._marks = np.zeros((0, 3))
        self._scene = scene
        self._traffic: Batch | None = None

    def set_source(self, source: Source) -> None:
        """Set the source: ellipsoids of a gain matrix are paler than those of a covariance."""
        self._ellipsoids.handle.opacity = _HONEST if source.honest else _GAIN

    def place(self, frame: Frame, look: Look) -> None:
        """Move everything to where it is in a frame."""
        R, R_hat = frame.vehicle_rotation, frame.estimate_rotation
        at = self._rounded(frame.vehicle_position + (R @ self._center[..., None])[..., 0])
        estimated = self._near(frame.estimate_position + (R_hat @ self._center[..., None])[..., 0])
        true, ghosts = placed(R, at, self._size), placed(R_hat, estimated, _SHELL * self._size)
        self.cars.put(true)
        self._arrows.put(true)
        self._ghosts.put(ghosts, look.estimates)
        self._frames.put(ghosts, look.estimates)
        self._place_ellipsoids(frame, look)
        self._place_landmarks(frame)
        self._place_traffic(frame)

    def _near(self, points: np.ndarray) -> np.ndarray:
        """Return points (N, 3), those very far away drawn nearer in their direction."""
        middle = np.array([*(self._stage.low + self._stage.high) / 2, 0.0])
        away = np.linalg.norm(points - middle, axis=-1, keepdims=True)
        share = np.minimum(1.0, _FAR * self._stage.side / np.maximum(away, 1e-9))
        return self._rounded(middle + (points - middle) * share)

    def _rounded(self, points: np.ndarray) -> np.ndarray:
        return fine(points, self._step)

    def _place_ellipsoids(self, frame: Frame, look: Look) -> None:
        semi, axes = semi_axes(frame.position_covariance)
        semi *= look.magnification
        drawn = semi[:, 2] <= _LARGEST * self._stage.side
        steps = np.log2(np.maximum(np.where(drawn[:, None], semi, np.nan), self._step / 4)) * _STEPS
        semi = 2.0 ** (np.round(steps) / _STEPS)
        self._ellipsoids.put(placed(axes, self._near(frame.estimate_position), semi, _TURN), look.ellipsoids)

    def _place_landmarks(self, frame: Frame) -> None:
        L, side = self._stage.landmarks, self._stage.side
        place = self._stage.targets(frame)[:L]
        if np.array_equal(place, self._marks, equal_nan=True):
            return
        self._marks = place
        self._dots.put(placed(None, self._rounded(place), np.full((L, 3), _DOT * side)))
        foot = np.column_stack([place[:, :2], np.full(L, self._ground.z)])
        thick = np.full((L, 1), 0.2 * _DOT * side)
        height = np.maximum(place[:, 2:] - self._ground.z, 0.0)
        self._poles.put(placed(None, self._rounded(foot), np.hstack([thick, thick, height])))
        if self._bodies:
            bodies = [body for landmark in self._stage.scenario.landmarks if (body := landmark.body)]
            R = frame.rotation[self._bodies]
            at = frame.position[self._bodies] + (R @ np.array([b.center for b in bodies])[..., None])[..., 0]
            self._boxes.put(placed(R, self._rounded(at), np.array([b.size for b in bodies])))

    def _place_traffic(self, frame: Frame) -> None:
        if not len(frame.traffic_half):
            return
        if self._traffic is None:
            grey = np.tile(np.array(rgb(TRAFFIC), np.uint8), (len(frame.traffic_half), 1))
            self._traffic = Batch(self._scene, f"{ROOT}/traffic", car(), grey, flat_shading=True)
        size = np.where(frame.traffic_half[:, :1] > 0.0, 2.0 * frame.traffic_half, np.nan)
        self._traffic.put(placed(frame.traffic_rotation, self._rounded(frame.traffic_position), size))
