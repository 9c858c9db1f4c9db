"""Pictures of a scene in 3-D, for films, lit and with shadows.

VTK, of the extra `film3d`, draws them without a display.
"""

from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from coopenv.base.errors import check_one_of
from coopenv.base.installation import install_command, needing
from coopenv.episode import Frame, semi_axes
from coopenv.estimation import Sight
from coopenv.observers.registry import states_covariance
from coopenv.scenario import Scenario
from coopenv.viz import meshes, stage
from coopenv.viz.meshes import ASPHALT, DARK, GRASS, GRID, HORIZON, MARKS, SUN, Mesh
from coopenv.viz.stage import Stage
from coopenv.viz.style import DARK_BLUE, GREY, INK, rgb, vehicle_colour

CAMERAS = ("overview", "follow", "pair", "driver")
"""Views from above the scene, from behind a vehicle, from above a vehicle and the nearest other vehicle, and through a
vehicle's camera."""
_SOUTH = np.array([0.0, -0.6, 0.8])  # direction from the middle to the camera that sees everything
_ANGLE, _AWAY = 40.0, 1.15  # its vertical field of view, deg, and its distance in the scene's sides
_SHORTEST = {"overview": 0.085, "pair": 0.045}  # of the scene's side, least length of a vehicle in a picture from above
_GHOST = 0.42  # opacity of an estimate
_LARGEST = 0.3  # of the scene's side, semi-axis of an ellipse that is drawn
_GRID = 8  # lines of the grid on the ground from the middle to an end
_LANES = 14  # dashes of a road's marks over a side of the scene
_BEHIND, _ABOVE = 5.5, 2.6  # lengths of the vehicle, of the camera that follows it
_STEEP, _SHARE = 50.0, 0.62  # of the camera above a pair: elevation, deg, and share of the height between the two
_SLOW = 0.75  # of the top speed, below which a vehicle of a pair waits
LEGEND = "solid: true pose, faded: estimate, thin line: measurement, ball: landmark"
"""Stands in pictures, but for those through a vehicle's camera."""
_LEFTMOST = 60.0  # deg, vertical field of view of a driver's camera that sees in every direction


class View3d:
    """Draws frames of a scenario from one camera; a stand-in for a `TopView`."""

    def __init__(self, scenario: Scenario, size: tuple[int, int], camera: str = "overview", vehicle: int = 0) -> None:
        """Build the scene.

        Args:
            scenario: of the frames.
            size: width and height of the pictures, pixels.
            camera: one of `CAMERAS`.
            vehicle: index of the one that is followed, or whose camera it is.

        Raises:
            CoopenvError: no such camera, or the extra is not installed.
        """
        check_one_of("unknown camera of a film", camera, CAMERAS)
        with needing(f"3-D films need an extra: {install_command('film3d')}"):
            import pyvista
        self._pv: Any = pyvista
        self._camera, self._picked = camera, vehicle
        with pyvista.vtk_verbosity("off"):  # it would report that there is no display
            self._build(scenario, size)
            self._plot.render()

    def _build(self, scenario: Scenario, size: tuple[int, int]) -> None:
        camera = self._camera
        self._stage = Stage(scenario)
        least = _SHORTEST.get(camera, 0.0) * self._stage.side
        self._size, self._center = self._stage.bodies(least)
        self._turn = Rotation.from_euler("z", stage.ways(scenario)[:, None]).as_matrix()
        self._plot: Any = self._pv.Plotter(off_screen=True, window_size=size, lighting="none")
        self._plot.set_background(HORIZON, top=meshes.SKY)
        self._honest = states_covariance(scenario.observer.name)
        self._before: Frame | None = None
        self.waits = False
        """True if the other vehicle of a pair drove below three quarters of its top speed."""
        self._shown = np.arange(self._stage.vehicles) != (self._picked if camera == "driver" else -1)
        self._outline = np.concatenate([points for points, _ in (meshes.car(), meshes.car_trim())])
        self._colours = [vehicle_colour(i) for i in range(self._stage.vehicles)]
        self._add_ground()
        self._add_actors()
        self._add_light()
        if camera == "overview":
            self._look_over()

    def paint(self, frame: Frame) -> np.ndarray:
        """Return an (H, W, 3) uint8 picture of a frame; estimates below their vehicles are drawn at their height."""
        R, R_hat = frame.rotation @ self._turn, frame.rotation_estimate @ self._turn
        estimate = self._stage.nearer(frame.position_estimate, meshes.FAR)
        estimate[:, 2] = np.maximum(estimate[:, 2], frame.position[:, 2])
        cars = self._boxes(R, frame.position), self._boxes(R_hat, estimate)
        for parts, places in zip((self._cars, self._ghosts), cars, strict=True):
            for actors, place, shown in zip(parts, places, self._shown, strict=True):
                for actor in actors:
                    _put(actor, place, shown)
        ends = np.stack([places[:, :3, 3] for places in cars], axis=1)
        self._draw_lines("error", ends[self._shown], np.flatnonzero(self._shown), 5.0)
        self._draw_shadows(frame, cars[0])
        self._draw_sight(frame)
        self._place_ellipses(frame, estimate)
        self._place_others(frame)
        pair = self._pair(frame) if self._camera == "pair" else None
        if pair is not None:
            self._look_at_pair(frame.position[pair], R[self._picked, :, 0])
        elif self._camera in ("follow", "driver"):
            self._move_camera(frame, R)
        self._plot.render()
        picture = np.asarray(self._plot.screenshot(return_img=True))[..., :3].copy()
        return self._lettered(picture, frame, {} if pair is None else self._captions(frame, pair))

    def close(self) -> None:
        """Let go of the renderer."""
        self._plot.close()

    def _mesh(self, mesh: Mesh, colour: str, **look: Any) -> Any:
        points, faces = mesh
        data = self._pv.PolyData.from_regular_faces(np.asarray(points, float), np.asarray(faces, np.int64))
        return self._plot.add_mesh(data, color=colour, **{"ambient": 0.42, "diffuse": 0.75, "specular": 0.0, **look})

    def _add_ground(self) -> None:
        here, z, side = self._stage, self._stage.floor, self._stage.side
        self._mesh(meshes.quad(here.middle[:2] + 20.0 * side * stage.CORNERS, z - 3e-3 * side), GRASS)
        at = np.arange(-_GRID, _GRID + 1) / _GRID
        lines = np.array([[(x, -1.0), (x, 1.0)] for x in at] + [[(-1.0, y), (1.0, y)] for y in at])
        ends = np.dstack([here.middle[:2] + 0.75 * side * lines, np.full((len(lines), 2), z - 2.5e-3 * side)])
        grid = self._pv.line_segments_from_points(ends.reshape(-1, 3))
        self._plot.add_mesh(grid, color=GRID, line_width=1, lighting=False)
        for i, (road, corners) in enumerate(zip(here.scenario.roads, stage.roads(here.scenario), strict=True)):
            self._mesh(meshes.quad(corners, z - (2e-3 - 1e-4 * (i % 8)) * side), ASPHALT)
            start, end = (np.array(point) - here.origin[:2] for point in (road.start, road.end))
            length = float(np.linalg.norm(end - start))
            count = max(1, round(_LANES * length / side))
            along = (end - start) / length
            aside = 0.012 * road.width * np.array([-along[1], along[0]])
            for k in range(count if road.marked else 0):
                a, b = (start + (k + share) / count * (end - start) for share in (0.2, 0.8))
                self._mesh(meshes.quad(np.array([a - aside, b - aside, b + aside, a + aside]), z - 1e-3 * side), MARKS)
        for building in here.buildings:
            _put(self._mesh(meshes.box(), meshes.WALL), _affine(building.rotation, building.center, building.size))

    def _add_actors(self) -> None:
        parts: list[tuple[Mesh, str | None, dict[str, Any]]]
        parts = [(meshes.car(), None, {"specular": 0.4}), (meshes.car_trim(), DARK, {}), (meshes.arrow(), "white", {})]
        self._cars = [
            [self._mesh(mesh, colour or own, **look) for mesh, colour, look in parts] for own in self._colours
        ]
        ghost: dict[str, Any] = {"opacity": _GHOST, "ambient": 0.8, "diffuse": 0.3}
        self._ghosts = [[self._mesh(meshes.car(), own, **ghost)] for own in self._colours]
        flat: dict[str, Any] = {"opacity": 0.3, "lighting": False}
        self._ellipses = [self._mesh(meshes.sphere(), own, **flat) for own in self._colours]
        self._landmarks = [
            (self._mesh(meshes.pole(), DARK_BLUE), self._mesh(meshes.sphere(6), DARK_BLUE, ambient=0.5))
            for _ in range(self._stage.landmarks)
        ]
        self._bodies: list[list[Any]] = []

    def _add_light(self) -> None:
        light = self._pv.Light
        self._plot.add_light(light(position=SUN, light_type="scene light", intensity=0.85, color="#FFF4E0"))
        self._plot.add_light(light(light_type="headlight", intensity=0.25, color="#DDE8FF"))

    def _draw_shadows(self, frame: Frame, cars: np.ndarray) -> None:
        """Draw the shadows that convex hulls of bodies and landmarks cast on the ground."""
        here = self._stage
        corners = [place[:3, :3] @ self._outline.T + place[:3, 3:] for place in cars[self._shown]]
        corners += [box.faces.reshape(-1, 3).T for box in (*here.buildings, *self._moving_bodies(frame))]
        ball, _ = meshes.sphere(4)
        for place in here.targets(frame)[: here.landmarks]:
            foot = [*place[:2], here.floor]
            corners.append(np.vstack([meshes.DOT * here.side * ball + place, foot]).T)
        outlines = []
        for points in (points for points in corners if np.isfinite(points).all()):
            flat = (points[:2] - SUN[:2, None] / SUN[2] * (points[2] - here.floor)).T
            outlines.append(flat[ConvexHull(flat).vertices])
        count = [len(outline) for outline in outlines]
        z = here.floor + 1e-3 * here.side * np.ones((sum(count), 1))
        faces = [part for n, at in zip(count, np.cumsum([0, *count]), strict=False) for part in (n, *range(at, at + n))]
        if outlines:
            data = self._pv.PolyData(np.hstack([np.concatenate(outlines), z]), faces=faces)
            look: dict[str, Any] = {"color": "black", "opacity": 0.33, "lighting": False}
            self._plot.add_mesh(data, name="shadows", render=False, reset_camera=False, **look)

    def _look_over(self) -> None:
        width, height = self._plot.window_size
        distance = _AWAY * self._stage.side * max(1.0, height / width)
        middle = self._stage.middle + self._stage.side * np.array([0.0, -0.03, 0.0])
        camera = self._plot.camera
        camera.position, camera.focal_point = tuple(middle + distance * _SOUTH), tuple(middle)
        camera.up, camera.view_angle = (0.0, 0.0, 1.0), _ANGLE

    def _move_camera(self, frame: Frame, R: np.ndarray) -> None:
        place, forward = frame.position[self._picked], R[self._picked, :, 0]
        camera, length = self._plot.camera, float(self._size[self._picked, 0])
        if not np.isfinite(place).all():
            return
        if self._camera == "follow":
            eye = place - _BEHIND * length * forward + [0.0, 0.0, _ABOVE * length]
            aim, angle = place + 2.5 * length * forward, _ANGLE
        else:
            own = self._stage.scenario.cameras[self._picked]
            pinhole = own.model == "pinhole"
            eye = self._stage.eyes(frame)[self._picked]
            axis = own.to_body(float(frame.pan[self._picked]))[:, 2] if pinhole else self._turn[self._picked, :, 0]
            aim = eye + frame.rotation[self._picked] @ axis
            focal = own.focal_length[1] if pinhole else 1.0
            angle = 2.0 * np.degrees(np.arctan(own.image_size[1] / 2.0 / focal)) if pinhole else _LEFTMOST
        camera.position, camera.focal_point, camera.up = tuple(eye), tuple(aim), (0.0, 0.0, 1.0)
        camera.view_angle = float(angle)
        camera.clipping_range = (0.05 * length, 60.0 * self._stage.side)

    def _pair(self, frame: Frame) -> list[int] | None:
        """Return the picked vehicle and the nearest other vehicle, or None if it has no true position."""
        place = frame.position
        away = np.linalg.norm(place - place[self._picked], axis=1)
        away[self._picked] = np.inf
        if not np.isfinite(place[self._picked]).all():
            return None
        other = int(np.nanargmin(away))
        return [self._picked, other if np.isfinite(away[other]) else self._picked]

    def _look_at_pair(self, places: np.ndarray, forward: np.ndarray) -> None:
        """Look from behind and above at two vehicles (2, 3), such that their distance fills most of the height."""
        along = np.array([*forward[:2], 0.0]) / max(float(np.linalg.norm(forward[:2])), 1e-9)
        steep = np.radians(_STEEP)
        span = max(float(np.linalg.norm(places[1] - places[0])), 4.0 * float(self._size[self._picked, 0]))
        distance = span * np.sin(steep) / _SHARE / (2.0 * np.tan(np.radians(_ANGLE / 2.0)))
        middle, camera = places.mean(axis=0), self._plot.camera
        camera.position = tuple(middle - distance * (np.cos(steep) * along - [0.0, 0.0, np.sin(steep)]))
        camera.focal_point, camera.up, camera.view_angle = tuple(middle), (0.0, 0.0, 1.0), _ANGLE
        camera.clipping_range = (0.05 * distance, 60.0 * self._stage.side)

    def _captions(self, frame: Frame, pair: list[int]) -> dict[int, str]:
        """Return, by vehicle of a pair, what the picked one sees, and whether the other one waits."""
        before, (picked, other) = self._before, pair
        if before is None or frame.tick > before.tick:
            self._before = frame
        if before is not None and frame.tick > before.tick:
            way = float(np.linalg.norm(frame.position[other] - before.position[other]))
            speed = way / (frame.tick - before.tick) * self._stage.scenario.rates.camera
            self.waits = speed < _SLOW * self._stage.scenario.limits[other].max_speed
        seen = np.flatnonzero(frame.sight[picked] == Sight.VISIBLE)
        names = ", ".join(self._stage.short_name(int(target)) for target in seen[:2]) + ", ..." * (len(seen) > 2)
        driving = {other: "waits" if self.waits else "drives on"} if other != picked else {}
        return {**driving, picked: f"sees {names or 'nothing'}"}

    def _lettered(self, picture: np.ndarray, frame: Frame, captions: dict[int, str]) -> np.ndarray:
        """Return a picture with the legend, and captions beside vehicles."""
        image = Image.fromarray(picture)
        height, width = picture.shape[:2]
        draw = ImageDraw.Draw(image)
        look: dict[str, Any] = {"fill": INK, "stroke_width": 2, "stroke_fill": "white"}
        if self._camera != "driver":
            small = ImageFont.load_default(0.034 * height)
            draw.text((0.02 * width, 0.97 * height), LEGEND, font=small, anchor="ls", **look)
        font = ImageFont.load_default(0.06 * height)
        for i, words in captions.items():
            u, v = self.pixel(frame.position[i])
            text = f"{stage.vehicle_mark(i)} {words}"
            if np.isfinite([u, v]).all():
                left = min(u + 0.08 * width, width - draw.textlength(text, font) - 3)
                draw.text((left, v), text, font=font, anchor="lm", **look)
        return np.asarray(image)

    def pixel(self, point: np.ndarray) -> tuple[float, float]:
        """Return column and row of a point (3,) of the map, m, in the picture that was drawn last."""
        width, height = self._plot.window_size
        matrix = self._plot.camera.GetCompositeProjectionTransformMatrix(width / height, -1, 1)
        x, y, _, w = np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)]) @ [*point, 1.0]
        return 0.5 * width * (1.0 + x / w), 0.5 * height * (1.0 - y / w)

    def _boxes(self, R: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the transforms (N, 4, 4) of vehicles' unit cubes."""
        center = position + (R @ self._center[..., None])[..., 0]
        return np.array([_affine(*each) for each in zip(R, center, self._size, strict=True)])

    def _place_ellipses(self, frame: Frame, estimate: np.ndarray) -> None:
        """Place the 3-sigma ellipses on the ground, but for large ones and ellipses of a gain matrix."""
        semi, axes = semi_axes(frame.position_covariance[:, :2, :2])
        drawn = self._honest & (semi[:, 1] <= _LARGEST * self._stage.side)
        for i, actor in enumerate(self._ellipses):
            R = np.eye(3)
            R[:2, :2] = axes[i]
            place = [*estimate[i, :2], self._stage.floor]
            _put(actor, _affine(R, place, [*semi[i], 1e-3 * self._stage.side]), bool(drawn[i]))

    def _place_others(self, frame: Frame) -> None:
        """Place landmarks, their bodies, and other traffic."""
        here = self._stage
        thick, dot = 0.15 * meshes.DOT * here.side, np.full(3, meshes.DOT * here.side)
        for (pole, ball), place in zip(self._landmarks, here.targets(frame), strict=False):
            foot = [*place[:2], here.floor]
            _put(pole, _affine(np.eye(3), foot, [thick, thick, max(place[2] - here.floor, 0.0)]))
            _put(ball, _affine(np.eye(3), place, dot))
        boxes = self._moving_bodies(frame)
        while len(self._bodies) < len(boxes):
            self._bodies.append([self._mesh(meshes.car(), GREY), self._mesh(meshes.car_trim(), DARK)])
        for k, actors in enumerate(self._bodies):
            for actor in actors:
                _put(actor, _affine(*boxes[k][1:4]) if k < len(boxes) else np.full((4, 4), np.nan))

    def _moving_bodies(self, frame: Frame) -> list[stage.Box]:
        return [box for box in self._stage.solid(frame) if box.agent < self._stage.landmarks]

    def _draw_sight(self, frame: Frame) -> None:
        observer, seen = np.nonzero((frame.sight == Sight.VISIBLE) & self._shown[:, None])
        ends = np.stack([self._stage.eyes(frame)[observer], self._stage.targets(frame)[seen]], axis=1)
        cars = seen >= self._stage.landmarks  # a vehicle that is measured, on which an estimate depends
        self._draw_lines("sight", ends[~cars], observer[~cars], 1.0, opacity=0.45)
        self._draw_lines(
            "sight of vehicles", ends[cars], observer[cars], 4.0 if self._camera == "pair" else 1.5, opacity=0.8
        )
        vehicle, lines = self._stage.reading_lines(frame)
        self._draw_lines("readings", lines[self._shown[vehicle]], vehicle[self._shown[vehicle]], 1.5, opacity=0.8)

    def _draw_lines(self, name: str, segments: np.ndarray, vehicle: np.ndarray, width: float, **more: Any) -> None:
        """Draw line segments (K, 2, 3) of vehicles (K,) in their colours; segments with NaN are left out."""
        good = np.isfinite(segments).all(axis=(1, 2))
        self._plot.remove_actor(name, render=False)
        if good.any():
            data = self._pv.line_segments_from_points(segments[good].reshape(-1, 3))
            data.cell_data["colour"] = np.array([rgb(self._colours[i]) for i in vehicle[good]])
            look = {"scalars": "colour", "rgb": True, "lighting": False, "line_width": width, **more}
            self._plot.add_mesh(data, name=name, render=False, reset_camera=False, **look)


def _affine(rotation: np.ndarray, center: Any, size: Any) -> np.ndarray:
    """Return the transform (4, 4) of a unit cube to a box."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = rotation * np.asarray(size, float), center
    return whole


def _put(actor: Any, place: np.ndarray, shown: bool = True) -> None:
    """Put an actor to a place (4, 4); NaN: hide it."""
    actor.visibility = bool(shown and np.isfinite(place).all())
    if actor.visibility:
        actor.user_matrix = place
