"""The image of a vehicle's camera: projected targets, drawn from the true poses."""

from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from coopenv.episode import Frame
from coopenv.estimation import Sight
from coopenv.estimation.lens import distort
from coopenv.scenario.sensing import Camera, rotation_of
from coopenv.viz.stage import Box, Stage
from coopenv.viz.style import DARK_BLUE, GREY, INK, NOTE, vehicle_colour
from coopenv.viz.topview_ground import GROUND, ROOF, TRAFFIC, WALL

SKY = "#E6EEF5"
_ALL_AROUND = (360, 120)  # pixels of the image of a camera that sees everything
_HIGH = 30.0  # deg that such an image reaches up and down
_SCALE = 2  # of the drawing, which is made smaller at the end
_NEAR = 0.05  # m before the camera, where boxes are cut
_AHEAD = 1e-3  # of the distance: depth from which on a point is ahead of the camera
_WIDEST = 2.0  # radius of the image plane at distance 1 from which on the polynomial of the lens is not valid


def camera_image(stage: Stage, frame: Frame, vehicle: int) -> np.ndarray:
    """Return the image of a vehicle's camera, (H, W, 3) uint8; a panorama where it sees in every direction.

    Targets that are measured are discs, those that are hidden or missed are rings; what hides them stands beside.
    """
    lens = Lens(stage, frame, vehicle)
    width, height = lens.size
    image = Image.new("RGB", (_SCALE * width, _SCALE * height), SKY)
    draw = ImageDraw.Draw(image)
    if np.isfinite(frame.position[vehicle]).all():
        _draw_ground(draw, lens)
        far = sorted(_boxes(stage, frame, vehicle), key=lambda each: -float(np.linalg.norm(each[0].center - lens.eye)))
        for box, colour, edge in far:
            _draw_box(draw, lens, box, colour, edge)
        _draw_targets(draw, stage, frame, vehicle, lens)
    else:
        draw.text((12, 12), "not there", fill=INK, font=ImageFont.load_default(22))
    return np.asarray(image.resize(lens.size, Image.Resampling.LANCZOS))


class Lens:
    """Projects points of the map to the pixels of one camera, at its nominal mounting."""

    def __init__(self, stage: Stage, frame: Frame, vehicle: int) -> None:
        """Take the camera of a vehicle at a frame."""
        self._camera: Camera = stage.scenario.cameras[vehicle]
        self.around = self._camera.model != "pinhole"
        self.size = _ALL_AROUND if self.around else self._camera.image_size
        self.eye = stage.eyes(frame)[vehicle]
        pan = float(frame.pan[vehicle])
        to_body = rotation_of(pan, None) if self.around else self._camera.to_body(pan)
        self._to_map = frame.rotation[vehicle] @ to_body

    def in_camera(self, points: np.ndarray) -> np.ndarray:
        """Return points (..., 3) of the map in the camera's frame; z ahead, but of a panorama x ahead and z up."""
        return np.asarray((points - self.eye) @ self._to_map)

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Return pixels (K, 2) of points in the camera's frame; NaN of those behind it."""
        if self.around:
            azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
            up = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
            width, height = self.size
            return np.column_stack([(180.0 - azimuth) * width / 360.0, (_HIGH - up) * height / (2 * _HIGH)])
        return pixels(points, self._camera)


def pixels(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the pixels (K, 2) of points (K, 3) in the optical frame of a pinhole camera; NaN of those behind it."""
    ahead = np.where(points[:, 2] > _AHEAD * np.linalg.norm(points, axis=1), points[:, 2], np.nan)
    flat = points[:, :2] / ahead[:, None]
    beyond = np.maximum(1.0, np.linalg.norm(flat, axis=1, keepdims=True) / _WIDEST)
    return np.asarray(beyond * distort(flat / beyond, camera.distortion) * camera.focal_length + camera.principal_point)


def _boxes(stage: Stage, frame: Frame, vehicle: int) -> list[tuple[Box, str, str]]:
    """Return the boxes before a camera with the colours of their faces and edges."""
    boxes = [(box, ROOF, WALL) for box in stage.buildings]
    for box in stage.solid(frame, (stage.landmarks + vehicle,)):
        own = box.agent - stage.landmarks
        boxes.append((box, vehicle_colour(own) if own >= 0 else DARK_BLUE if box.agent >= 0 else TRAFFIC, "white"))
    return [each for each in boxes if np.isfinite(each[0].center).all()]


def _draw_ground(draw: ImageDraw.ImageDraw, lens: Lens) -> None:
    """Fill the image below the horizon."""
    width, height = lens.size
    if lens.around:
        draw.rectangle([0, _SCALE * height // 2, _SCALE * width, _SCALE * height], fill=GROUND)
        return
    direction = lens.in_camera(lens.eye + np.array([[0.0, 0.0, -1.0]]))[0]
    if abs(direction[1]) > 0.2:
        (fx, fy), (cx, cy) = lens._camera.focal_length, lens._camera.principal_point
        left, right = (
            cy + fy * -(direction[2] + direction[0] * (u - cx) / fx) / direction[1] for u in (0.0, float(width))
        )
        below = 4.0 * height * np.sign(direction[1])
        corners = [(0.0, left), (width, right), (width, right + below), (0.0, left + below)]
        draw.polygon([(_SCALE * u, _SCALE * v) for u, v in corners], fill=GROUND)


def _draw_box(draw: ImageDraw.ImageDraw, lens: Lens, box: Box, colour: str, edge: str) -> None:
    for face in sorted(lens.in_camera(box.faces), key=lambda each: -float(np.linalg.norm(each.mean(axis=0)))):
        whole = face if lens.around else _before(face)
        if len(whole) < 3:
            continue
        outline = lens.pixels(whole)
        if lens.around and np.ptp(outline[:, 0]) > lens.size[0] / 2:
            continue  # it is behind, on both sides of the panorama
        if (outline.max(axis=0) < 0).any() or (outline.min(axis=0) > lens.size).any():
            continue
        points = [(float(u), float(v)) for u, v in np.clip(_SCALE * outline, -5000, 5000)]
        draw.polygon(points, fill=colour, outline=edge)


def _before(face: np.ndarray) -> np.ndarray:
    """Return the part of a polygon (K, 3) that lies before the camera."""
    near = max(_NEAR, 2.0 * _AHEAD * float(np.linalg.norm(face, axis=1).max()))  # what is kept has pixels
    kept = []
    for a, b in zip(face, np.roll(face, -1, axis=0), strict=True):
        if a[2] > near:
            kept.append(a)
        if (a[2] > near) != (b[2] > near):
            kept.append(a + (near - a[2]) / (b[2] - a[2]) * (b - a))
    return np.array(kept).reshape(-1, 3)


def _draw_targets(draw: ImageDraw.ImageDraw, stage: Stage, frame: Frame, vehicle: int, lens: Lens) -> None:
    pixels = lens.pixels(lens.in_camera(stage.targets(frame)))
    width, height = lens.size
    radius, colour = 3.5 * _SCALE, vehicle_colour(vehicle)
    rims = {Sight.VISIBLE: "white", Sight.MISSED: colour, Sight.OCCLUDED_BY_BUILDING: GREY, Sight.OCCLUDED_BY_BODY: INK}
    for target in np.flatnonzero(np.isfinite(pixels).all(axis=1)):
        (u, v), kind = pixels[target], frame.sight[vehicle, target]
        inside = -4 <= u <= width + 4 and -4 <= v <= height + 4
        if not inside or kind not in rims:
            continue
        x, y = _SCALE * float(u), _SCALE * float(v)
        around = [x - radius, y - radius, x + radius, y + radius]
        draw.ellipse(around, fill=colour if kind == Sight.VISIBLE else None, outline=rims[kind], width=_SCALE)
        hider = stage.hider(frame, vehicle, int(target))
        words = stage.short_name(int(target)) + (f" behind {hider}" if hider else "")
        side = "rs" if x > _SCALE * width * 0.7 else "ls"
        gap = -radius - 3 if side == "rs" else radius + 3
        look: dict[str, Any] = {"stroke_width": _SCALE, "stroke_fill": "white", "anchor": side}
        look |= {"font": ImageFont.load_default(11 * _SCALE), "fill": INK if kind == Sight.VISIBLE else NOTE}
        draw.text((x + gap, y - 2), words, **look)
