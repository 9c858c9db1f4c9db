"""Frames with tags: a renderer, and worlds whose bearings come from rendered frames by the detector of tags."""

from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from coopenv.base.errors import CoopenvError
from coopenv.cars.messages.vision import Calibration, dictionary_of, find_tags, opencv, rays
from coopenv.estimation import Sight
from coopenv.estimation.poses import Array
from coopenv.scenario import Scenario
from coopenv.sources.worlds import Simulated, SimulatedWorld
from coopenv.world.random import BEARING_NOISE
from coopenv.world.step import Kernels, source_kernels

INSIDE = (np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0)), axis=-1).reshape(-1, 2) - 1.5) / 4.0
"""Rays through a pixel, from its middle: downwards and to the right, in pixels."""

WHITE, BLACK, WALL, OUTSIDE = 220.0, 30.0, 120.0, -1.0
"""Shades of tags, of their background, and outside of tags."""


class PlacedTag(NamedTuple):
    """A tag in front of a camera."""

    number: int
    axes: Array  # (3, 3) columns: to its right, downwards and behind it, as its reader sees it; optical frame
    place: Array  # (3,) of its centre, optical frame, m
    side: float  # of its black square, m; a white border of one cell is around it


@cache
def pattern(family: str, number: int) -> Array:
    """Return the shades of the cells of a tag, border included. Raises CoopenvError: the family has no such number."""
    dictionary = dictionary_of(family)
    if not 0 <= number < (count := len(dictionary.bytesList)):
        raise CoopenvError(f"marker {number}: {family} has 0 to {count - 1}")
    cells = opencv().aruco.generateImageMarker(dictionary, number, dictionary.markerSize + 2)
    return np.where(np.pad(cells, 1, constant_values=255) > 127, WHITE, BLACK)


@lru_cache(maxsize=16)
def pixel_rays(calibration: Calibration) -> tuple[Array, Array, Array]:
    """Return the rays (height, width, 3) of all pixels, at depth 1, and their changes downwards and to the right."""
    width, height = calibration.image_size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    units, there = rays(pixels.astype(np.float64), calibration)
    units[~there] = np.nan  # meets no tag
    found = (units / units[:, 2:]).reshape(height, width, 3)
    return found, *np.gradient(found)[:2]  # per pixel: nearly the same all over it


def facing(number: int, place: Array, side: float) -> PlacedTag:
    """Return an upright tag that faces the camera; `place` (3,) is its centre, optical frame, m, `side` in m."""
    across = np.array([place[2], 0.0, -place[0]]) / np.hypot(place[0], place[2])
    axes = np.stack([across, [0.0, 1.0, 0.0], np.cross(across, [0.0, 1.0, 0.0])], axis=-1)
    return PlacedTag(number, axes, place, side)


class FrameRenderer:
    """Renders frames of one camera; pixels have whole numbers in their middle, as in OpenCV."""

    def __init__(self, calibration: Calibration, family: str) -> None:
        """Find the rays of all pixels."""
        self.calibration, self.family = calibration, family
        self._rays, self._down, self._right = pixel_rays(calibration)

    def render(
        self, tags: Sequence[PlacedTag], blur: float, noise: float, rng: np.random.Generator, behind: Any = WALL
    ) -> NDArray[np.uint8]:
        """Return a frame (height, width) of tags before shades of that size, or one shade.

        Blur is in pixels, noise in shades, standard deviations both.
        """
        frame = np.empty(self._rays.shape[:2], np.float32)
        frame[:] = behind
        for tag in sorted(tags, key=lambda tag: -float(np.linalg.norm(tag.place))):
            self._paint(frame, tag)
        if blur:
            frame = opencv().GaussianBlur(frame, (0, 0), blur)
        frame += np.float32(noise) * rng.standard_normal(frame.shape, np.float32)
        return np.asarray(np.rint(frame).clip(0, 255), dtype=np.uint8)

    def _paint(self, frame: NDArray[Any], tag: PlacedTag) -> None:
        shades = np.pad(pattern(self.family, tag.number), 1, constant_values=OUTSIDE)
        cells, cell = len(shades) - 2, tag.side / (len(shades) - 4)
        box = self._box(tag, 0.5 * cells * cell)
        if box is None:
            return
        n, p = tag.axes[:, 2], tag.place
        rows = [((n @ p) * a - (a @ p) * n) / cell + 0.5 * cells * n for a in tag.axes[:, :2].T]
        H = np.array([*rows, n])  # from rays to the cells, homogeneous
        middle, down, right = (part[box] @ H.T for part in (self._rays, self._down, self._right))
        behind, found = frame[box], shades[_cells(middle, cells)]
        mixed = maximum_filter(found, 3) != minimum_filter(found, 3)  # most pixels of a near tag have one shade
        through = middle[mixed, None] + INSIDE[:, :1] * down[mixed, None] + INSIDE[:, 1:] * right[mixed, None]
        fine = shades[_cells(through, cells)]
        found = np.where(found == OUTSIDE, behind, found)
        found[mixed] = np.where(fine == OUTSIDE, behind[mixed, None], fine).mean(axis=-1)
        frame[box] = found

    def _box(self, tag: PlacedTag, half: float) -> tuple[slice, slice] | None:
        """Return rows and columns of the pixels that a tag may cover; None: none."""
        along = np.linspace(-half, half, 9)
        rim = np.array([(u, v) for w in (-half, half) for a in along for u, v in ((a, w), (w, a))])
        points = tag.place + rim @ tag.axes[:, :2].T
        if (points[:, 2] <= 1e-3).any() or tag.axes[:, 2] @ tag.place <= 0.0:  # behind the camera, or its back
            return None
        pixels = self.calibration.pixels(points)
        low = np.floor(pixels.min(axis=0)).astype(int) - 1
        high = np.ceil(pixels.max(axis=0)).astype(int) + 2
        (left, top), (right, bottom) = low.clip(0), np.minimum(high, self.calibration.image_size)
        return (slice(top, bottom), slice(left, right)) if top < bottom and left < right else None


def _cells(at: Array, cells: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns, from 1 on, of places (..., 3) on a tag, homogeneous in cells; 0 or beyond: outside."""
    with np.errstate(all="ignore"):
        on = np.where(at[..., 2:] > 0.0, at[..., :2] / at[..., 2:], -1.0)
    column, row = np.moveaxis(np.floor(on).clip(-1, cells).astype(np.intp) + 1, -1, 0)
    return row, column


class RenderedWorld(SimulatedWorld):
    """A world whose bearings are those of tags in rendered frames; all else is as in the simulation.

    The world decides which tags a vehicle has in view; nearer tags cover those behind them in its frame.
    """

    def __init__(self, scenario: Scenario, worlds: int, dtype: str, device: str, threads: Any, *observer: Any) -> None:
        """Build the arrays and the renderers; arguments as for `World`, `threads` is not used.

        Raises:
            CoopenvError: more than one world, or not on the CPU; and as for `World`.
        """
        if worlds != 1 or device != "cpu":
            where = f"got num_worlds={worlds}, device='{device}'"
            raise CoopenvError(f"sensing: 'images' renders one world on the CPU: num_worlds=1, device='cpu', {where}")
        super().__init__(scenario, worlds, dtype, device, 1, *observer)
        self._cameras, self._late = scenario.cameras, self.model.camera.numpy()["latency_ticks"].tolist()
        self._noisy = [noise.enabled for noise in scenario.noises]
        self._renderers = [FrameRenderer(Calibration.of(camera), scenario.images.family) for camera in self._cameras]

    def set_parameters(self, values: Mapping[str, np.ndarray], worlds: np.ndarray) -> None:
        """Set the parameters of the next resets, see `World`. Raises CoopenvError: a factor of bearing noise."""
        if not np.isnan(values.get("bearing_noise", np.nan)).all():
            raise CoopenvError("parameters: bearing_noise: the errors of rendered frames are the detector's")
        super().set_parameters(values, worlds)

    @property
    def _world_kernels(self) -> Kernels:
        return source_kernels(self.source, self.precision)

    def restart(self) -> None:
        """Start the next episode, see `World.restart`; the bearings of the simulation have no noise."""
        self.view("parameter_set")[:, BEARING_NOISE] = 0.0
        super().restart()
        if self.mask.numpy()[0] != 0:
            self._detect(0, np.zeros_like(self.view("bearing")[0]), np.full_like(self.view("bearing_tick")[0], -1))

    def advance(self, ticks: int) -> None:
        """Run camera ticks, see `World.advance`; the detector runs before the observers of each."""
        self._revive(ticks)
        self.decide()
        for _ in range(ticks):
            self.sense()
            self.launch.by_lane("follow", *self._follow(1))

    def sense(self) -> None:
        """Move the truth to the next tick, render its frames and detect their tags."""
        tick, active = int(self.view("tick")[0]), self.mask.numpy()[0] == 0
        before = self.view("bearing")[0].copy(), self.view("bearing_tick")[0].copy()
        super().sense()
        if active and tick < self.model.horizon_ticks:
            self._detect(tick + 1, *before)

    def _detect(self, tick: int, bearing: Array, bearing_tick: Array) -> None:
        """Replace what is measured at a tick; targets without a detection keep their last `bearing` and its tick."""
        sight, exact = self.view("sight")[0], self._pointed("bearing", 0)
        visible = sight == Sight.VISIBLE
        sight[visible] = Sight.MISSED
        bearings, ticks = self.view("bearing")[0], self.view("bearing_tick")[0]
        bearings[...], ticks[...] = bearing, bearing_tick
        for vehicle in np.flatnonzero(visible.any(axis=-1)).tolist():
            for target, ray in self._found(vehicle, tick, np.flatnonzero(visible[vehicle]), exact[vehicle]).items():
                sight[vehicle, target], ticks[vehicle, target] = Sight.VISIBLE, max(tick - self._late[vehicle], 0)
                bearings[vehicle, target] = ray

    def _found(self, vehicle: int, tick: int, visible: NDArray[Any], exact: Array) -> dict[int, Array]:
        """Return the unit bearings (3,) by target that a detector finds where tags are along unit rays (T, 3).

        Bearings are those of a camera without pan, see `coopenv.world.camera`.
        """
        images, camera, renderer = self.scenario.images, self._cameras[vehicle], self._renderers[vehicle]
        drawn = [int(self.view(name)[0]) for name in ("seed", "episode")]
        rng, noisy = np.random.default_rng([*drawn, tick, vehicle]), self._noisy[vehicle]
        panned = camera.to_body().T @ camera.to_body(float(self.view("pan")[0, vehicle]))
        places = exact @ panned * self._distances(vehicle)[:, None]
        tags = [facing(target, places[target], images.side) for target in visible.tolist()]
        frame = renderer.render(tags, images.blur, noisy * images.noise, rng)
        targets, best = self.observer_init.setups[vehicle].targets, dict[int, Array]()
        for tag in sorted(find_tags(frame, images.family, renderer.calibration), key=lambda tag: tag.size):
            others = [target for target in targets if target != tag.number]
            wrong = rng.random() < noisy * images.wrong_identity and others
            number = int(rng.choice(others)) if wrong else tag.number
            if tag.ray is not None and number in targets:
                best[number] = panned @ tag.ray  # of a number the largest
        return best

    def _distances(self, vehicle: int) -> Array:
        """Return how far the tags (T,) of all targets are from a vehicle's camera, m."""
        R, position, own = self._copy("rotation", 0), self._copy("position", 0), self.model.landmarks + vehicle
        tags = position + (R @ self.model.scene.marker.numpy().astype(float)[..., None])[..., 0]
        lens = position[own] + R[own] @ self._cameras[vehicle].position
        return np.asarray(np.linalg.norm(tags - lens, axis=-1))


class Rendered(Simulated):
    """A simulated world with rendered frames (`sensing = "images"`)."""

    def __init__(self, scenario: Scenario) -> None:
        """Simulate a scenario. Raises CoopenvError: no OpenCV, or the family has too few tags."""
        family, targets = scenario.images.family, len(scenario.target_names)
        if (tags := len(dictionary_of(family).bytesList)) < targets:
            raise CoopenvError(f"images.family: {family} has {tags} tags, the scenario has {targets} targets")
        super().__init__(scenario)

    def kind(self, *arguments: Any) -> RenderedWorld:
        """Return the world; arguments and errors as for `RenderedWorld`."""
        return RenderedWorld(*arguments)
