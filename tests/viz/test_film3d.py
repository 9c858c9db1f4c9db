"""Pictures in space against projections by hand and against the camera's own model."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation

import coopenv
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.episode import FIELDS, Episode, Frame, Origin
from coopenv.estimation import Sight
from coopenv.runs.films import cause_of_loss
from coopenv.viz.perspective import Lens
from coopenv.viz.stage import Stage, entries
from coopenv.viz.style import vehicle_colour

pytest.importorskip("pyvista", reason="needs the extra film3d")
from coopenv.viz.view3d import View3d

SIZE = (480, 360)


@pytest.fixture(scope="module")
def frame() -> Iterator[Frame]:
    with closing(Engine(coopenv.load_scenario("urban_crossing"))) as engine:
        engine.reset([3])
        yield Frame.of(engine)


def seen_from_above(point: np.ndarray, stage: Stage) -> tuple[int, int]:
    """Column and row of a point in the overview: a pinhole camera of 40 deg, 1.15 sides to the south and above."""
    middle = stage.middle - np.array([0.0, 0.03 * stage.side, 0.0])
    forward, right = np.array([0.0, 0.6, -0.8]), np.array([1.0, 0.0, 0.0])
    ray = point - (middle - 1.15 * stage.side * forward)
    focal = SIZE[1] / 2 / np.tan(np.radians(20.0))
    depth = ray @ forward
    return (
        int(SIZE[0] / 2 + focal * (ray @ right) / depth),
        int(SIZE[1] / 2 - focal * (ray @ np.cross(right, forward)) / depth),
    )


def hue_around(picture: np.ndarray, place: tuple[int, int], colour: str) -> float:
    """Largest cosine between the colours about a place and one, both without their brightness."""
    column, row = place
    part = picture[max(row - 4, 0) : row + 5, max(column - 4, 0) : column + 5].reshape(-1, 3).astype(float)
    part -= part.mean(axis=1, keepdims=True)
    wanted = np.array(to_rgb(colour)) - np.mean(to_rgb(colour))
    return float((part @ wanted / np.maximum(np.linalg.norm(part, axis=1), 6.0) / np.linalg.norm(wanted)).max())


def test_cars_and_their_estimates_stand_where_a_pinhole_camera_sees_them(frame: Frame) -> None:
    scenario = coopenv.load_scenario("urban_crossing")
    stage = Stage(scenario)
    aside = replace(frame, position_estimate=frame.position + 3.5 * frame.rotation[:, :, 0])
    aside = replace(aside, position_covariance=1e-6 * np.tile(np.eye(3), (4, 1, 1)))
    with closing(View3d(scenario, SIZE)) as view:
        here, apart = view.paint(frame), view.paint(aside)
    assert here.shape == (360, 480, 3) and here.dtype == np.uint8
    middle = np.array([0.0, 0.0, stage.floor])
    for i in range(stage.vehicles):
        at = seen_from_above(frame.position[i] * [1, 1, 0] + middle, stage)
        assert hue_around(here, at, vehicle_colour(i)) > 0.9, i
        ghost = seen_from_above(aside.position_estimate[i] * [1, 1, 0] + middle, stage)
        drawn = np.where(apart == here, 128, apart)  # grey where nothing new is drawn
        assert hue_around(drawn, ghost, vehicle_colour(i)) > 0.8, i


def test_buildings_cast_shadows_away_from_the_sun(frame: Frame) -> None:
    scenario = coopenv.load_scenario("urban_crossing")
    stage = Stage(scenario)
    with closing(View3d(scenario, SIZE)) as view:
        picture = view.paint(frame).astype(float)
    house = max(stage.buildings, key=lambda box: box.center[1] - box.center[0])
    aside = np.array([0.5 * house.size[0] + 0.2 * house.size[2], 0.3 * house.size[1], stage.floor - house.center[2]])
    column, row = seen_from_above(house.center + aside, stage)
    assert picture[row, column].sum() < 0.8 * picture[5, 5].sum()  # a corner of the lawn


def test_a_driver_sees_targets_where_its_camera_images_them(frame: Frame) -> None:
    """The first vehicle is turned such that a landmark before which nothing stands is to the left of its axis."""
    scenario = coopenv.load_scenario("urban_crossing")
    stage = Stage(scenario)
    away = stage.targets(frame)[: stage.landmarks] - stage.eyes(frame)[0]
    free = entries(
        np.tile(stage.eyes(frame)[0], (len(away), 1)), away, [*stage.buildings, *stage.solid(frame, (stage.landmarks,))]
    )
    target = min(np.flatnonzero((free > 1.0).all(axis=0)), key=lambda i: np.linalg.norm(away[i]))
    rotation = frame.target_rotation.copy()
    rotation[stage.landmarks] = Rotation.from_euler("z", np.arctan2(away[target, 1], away[target, 0]) - 0.2).as_matrix()
    turned = replace(frame, target_rotation=rotation)
    lens = Lens(stage, turned, 0)
    with closing(View3d(scenario, lens.size, "driver", 0)) as view:
        picture = view.paint(turned).astype(float)
    (u, v), *_ = lens.pixels(lens.in_camera(stage.targets(turned)[[target]]))
    assert u < 0.45 * lens.size[0]
    assert picture[round(v), round(u)].mean() < 70.0 < picture[round(v), round(u) - 40].mean()  # a landmark is dark


def test_the_pair_camera_shows_both_cars_with_the_line_of_sight_between_them() -> None:
    scenario = coopenv.load_scenario("lighthouse")
    with closing(Engine(scenario)) as engine:
        engine.reset([0])
        start = Frame.of(engine)
    leader, follower = start.landmarks, start.landmarks + 1
    sight = np.full_like(start.sight, Sight.OUT_OF_VIEW)
    seen = sight.copy()
    seen[1, leader] = Sight.VISIBLE
    blind, seeing = replace(start, sight=sight), replace(start, sight=seen)
    place = start.target_position.copy()
    place[leader] += 0.5 * start.target_rotation[leader, :, 0]
    second = start.tick + round(scenario.rates.camera)
    with closing(View3d(scenario, SIZE, "pair", 1)) as view:
        pictures = [view.paint(frame).astype(float) for frame in (blind, seeing)]
        pixels = [np.array(view.pixel(start.target_position[i])) for i in (leader, follower)]
        view.paint(replace(blind, target_position=place, tick=second))
        slow = view.waits
        place = place.copy()
        place[leader] += start.target_rotation[leader, :, 0]
        view.paint(replace(blind, target_position=place, tick=second + round(scenario.rates.camera)))
        assert slow and not view.waits  # 0.5 m/s and 1 m/s, of 1 m/s
    for (u, v), i in zip(pixels, (0, 1), strict=True):
        assert 0 < u < SIZE[0] and 0 < v < SIZE[1]
        assert hue_around(pictures[0], (round(u), round(v)), vehicle_colour(i)) > 0.9
    assert np.linalg.norm(pixels[1] - pixels[0]) > 0.4 * SIZE[1]
    column, row = np.round((pixels[0] + pixels[1]) / 2).astype(int)
    changed = np.abs(pictures[1] - pictures[0]).sum(axis=-1)
    assert changed[row - 9 : row + 10, column - 9 : column + 10].max() > 60.0


def rows_of(frame: Frame) -> dict[str, list[np.ndarray]]:
    return {name: [getattr(frame, name)] for name in FIELDS}


def test_a_heading_names_the_cause_of_a_loss(frame: Frame) -> None:
    """Metres of error are the drivers' fault where the covariance states them, and else the observer's."""
    scenario, stage = coopenv.load_scenario("urban_crossing"), Stage(coopenv.load_scenario("urban_crossing"))
    far = replace(frame, tick=frame.tick + 100, position_error=np.full(4, 5.0))

    def cause(covariance: float, **source: object) -> str:
        stated = replace(far, position_covariance=covariance * np.tile(np.eye(3), (4, 1, 1)))
        record = Episode(scenario, Origin.of("urban_crossing", scenario, **source), rows_of(stated))
        return cause_of_loss(record, stage, stated)

    assert cause(4.0, policy="peek") == "the drivers see too little"
    assert cause(4.0) == "stated as uncertain"
    assert cause(1.0, policy="peek") == "the observer is wrong"
    record = Episode(scenario, Origin.of("urban_crossing", scenario), rows_of(frame))
    assert cause_of_loss(record, stage, frame) == "initial estimates"


def test_an_unknown_camera_is_reported() -> None:
    with pytest.raises(CoopenvError, match="unknown camera of a film 'above'; known: overview, follow, pair, driver"):
        View3d(coopenv.load_scenario("facade"), SIZE, "above")
