"""The top view: its picture is read back pixel by pixel, its geometry against independent formulas."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import combinations
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import pyplot as plt
from matplotlib.backends import backend_registry
from matplotlib.colors import to_rgb

import coopenv
from coopenv.api.engine import Engine
from coopenv.base.format import fixed
from coopenv.episode import Frame
from coopenv.estimation import Sight
from coopenv.scenario import load_scenario
from coopenv.scenario.sensing import Camera
from coopenv.viz.perspective import Lens, _before, camera_image, pixels
from coopenv.viz.stage import Box, Stage, camera_fan, ellipses, free_lengths, limits
from coopenv.viz.style import ORANGE, vehicle_colour
from coopenv.viz.topview import PictureWindow, TopView
from coopenv.viz.topview_ground import HEIGHT, MAP_WIDTH, PANEL, ROW, TABLE_TOP, WIDTH, touching
from tests.helpers.builders import scenario
from tests.helpers.env_suite import ALIKE, each_slow
from tests.helpers.four_way import FOUR_WAY


@pytest.fixture(scope="module")
def busy() -> Any:
    env = coopenv.parallel_env("busy_intersection", render_mode="rgb_array")
    env.reset(seed=1)
    env.render()
    return env


@pytest.fixture
def start(busy: Any) -> Any:
    busy.reset(seed=1)
    return busy


def drawn(made: Any, **options: Any) -> tuple[Engine, TopView]:
    """Return an engine at the start of an episode of a scenario, or of one by name, and its view after drawing it."""
    engine = Engine(load_scenario(made) if isinstance(made, str) else made)
    engine.reset([0])
    view = TopView(engine.backend.scenario, **options)
    view.draw(engine)
    return engine, view


def drive(env: Any, steps: int, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        env.step({agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.agents})


def at(picture: np.ndarray, view: TopView, x: float, y: float) -> np.ndarray:
    """Return the colour of the picture at a point in m."""
    column, row = view._axes.transData.transform((x, y))
    return picture[HEIGHT - 1 - int(row), int(column)]


def assert_colour(rgb: np.ndarray, name: str) -> None:
    np.testing.assert_allclose(rgb, np.array(to_rgb(name)) * 255, atol=8)


@pytest.mark.parametrize("name", each_slow(coopenv.list_envs(), *ALIKE))
def test_draws_every_environment_and_leaves_its_state_alone(name: str) -> None:
    env = coopenv.parallel_env(name, render_mode="rgb_array")
    env.reset(seed=0)
    drive(env, 3)
    before = env.engine.get_state()
    picture = env.render()
    env.state()
    env.engine.refresh()
    after = env.engine.get_state()
    assert picture.shape == (HEIGHT, WIDTH, 3) and picture.dtype == np.uint8
    assert picture.flags.owndata and picture.std() > 10
    assert before.keys() == after.keys()
    for key in before.keys() - {"programs"}:  # objects of co-simulators
        np.testing.assert_array_equal(before[key], after[key], err_msg=key)
    stage, frame = Stage(env.scenario), Frame.of(env.engine)
    for i in range(0, stage.vehicles, 1 + stage.vehicles // 8):
        image, (width, height) = camera_image(stage, frame, i), Lens(stage, frame, i).size
        assert image.shape == (height, width, 3) and image.std() > 1.0


@given(st.lists(st.tuples(*[st.floats(-200.0, 200.0)] * 3), min_size=4, max_size=4))
def test_what_is_kept_of_a_large_face_has_pixels(corners: list[tuple[float, float, float]]) -> None:
    kept = _before(np.array(corners))
    assert np.isfinite(pixels(kept, Camera(range=6.0))).all()


def test_vehicles_move_over_a_ground_that_stays(start: Any) -> None:
    first = start.render()
    drive(start, 50)
    second = start.render()
    changed = np.any(first != second, axis=-1)
    assert 0.005 < changed.mean() < 0.5
    below_the_table = HEIGHT - int(TABLE_TOP) + ROW * 6
    assert not changed[below_the_table:, int(PANEL) :].any()
    axes = start.engine.top_view._axes.get_window_extent()
    assert not changed[:, : int(axes.x0) - 1].any()
    assert not changed[HEIGHT - int(axes.y0) + 1 :].any()
    x, y = start.engine.view("position")[0, 3 + 4, :2].tolist()
    assert_colour(at(second, start.engine.top_view, x - 0.4, y + 0.3), ORANGE)
    assert x == pytest.approx(-27.0, abs=1e-3)
    assert_colour(at(first, start.engine.top_view, x - 3.4, y + 0.3), ORANGE)


def test_equal_states_give_equal_pictures_whatever_was_drawn_before(start: Any) -> None:
    drive(start, 5)
    state, picture = start.get_state(), start.render()
    drive(start, 20)
    assert np.any(start.render() != picture)
    start.set_state(state)
    np.testing.assert_array_equal(start.render(), picture)
    np.testing.assert_array_equal(TopView(start.scenario).draw(start.engine), picture)


def test_a_map_alone_has_time_and_error_above_it(start: Any) -> None:
    drive(start, 30)
    whole, view = start.render(), TopView(start.scenario, panel=False)
    alone = view.draw(start.engine)
    below = HEIGHT - int(view._axes.get_window_extent().y1)
    assert alone.shape == (HEIGHT, MAP_WIDTH, 3)
    np.testing.assert_array_equal(alone[below:], whole[below:, :MAP_WIDTH])
    error = start.engine.view("position_error")[0]
    seconds = 30.0 / start.scenario.rates.decision
    assert view._time.get_text() == f"mean error {fixed(error.mean(), 2)} m   t = {seconds:.2f} s"
    extent = view._time.get_window_extent()
    assert extent.x1 <= MAP_WIDTH
    assert extent.x0 > 0.4 * MAP_WIDTH  # left of it is room for an agent's name


@pytest.mark.parametrize(
    ("name", "observer", "there", "not_there"),
    [
        ("crossing_path", "riccati", "hidden by a body", "hidden by a building"),  # its landmarks have bodies
        ("busy_intersection", "riccati", "no 3σ: P is a gain matrix", "hidden by a building"),
        ("busy_intersection", "robust", "landmark", "no 3σ: P is a gain matrix"),
    ],
)
def test_the_legend_lists_what_occurs(name: str, observer: str, there: str, not_there: str) -> None:
    view = TopView(load_scenario(name, {"observer.name": observer}))
    words = {text.get_text() for legend in view._figure.legends for text in legend.get_texts()}
    assert there in words and not_there not in words


def test_lines_of_sight_say_who_sees_whom_and_what_is_hidden() -> None:
    engine = Engine(load_scenario("overtaking"))
    engine.reset([0])
    engine.step(ticks=30 * 60)
    view = TopView(engine.world.scenario)
    view.draw(engine)
    sight = engine.view("sight")[0]
    for kind, lines in view._sight.items():
        assert len(lines.get_segments()) == np.sum(sight == kind)
    hidden = view._sight[Sight.OCCLUDED_BY_BODY]
    assert len(hidden.get_segments()) == 2 and len(view._sight[Sight.VISIBLE].get_segments()) == 7
    _, dashes = hidden.get_linestyle()[0]
    assert dashes and view._sight[Sight.VISIBLE].get_linestyle()[0][1] is None
    start, end = hidden.get_segments()[0]
    np.testing.assert_allclose(start, engine.view("position")[0, 5, :2] + [0.0, 0.3218], atol=1e-6)
    np.testing.assert_allclose(end, engine.view("position")[0, np.flatnonzero(sight[1] == 4)[0], :2], atol=1e-6)


def test_ended_vehicles_are_marked() -> None:
    engine, view = drawn(FOUR_WAY)
    plain = view.draw(engine)
    state = engine.get_state()
    state["ended"][0] = [1, 0, 2, 0]
    engine.set_state(state)
    marked = view.draw(engine)
    for marks, vehicle in ((view._arrived, 0), (view._collided, 2)):
        place = np.array(marks.get_data())[:, 0]
        assert np.linalg.norm(place - engine.view("position")[0, 12 + vehicle, :2]) < 0.3
    assert 100 < np.any(plain != marked, axis=-1).sum() < 2000


def test_ellipse_is_the_3_sigma_contour() -> None:
    covariance = np.array([[[4.0, 1.0], [1.0, 2.0]], [[1.0, 0.0], [0.0, -1.0]], [[np.nan] * 2] * 2])
    center = np.array([[1.0, -2.0], [0.0, 0.0], [0.0, 0.0]])
    shape, semi = ellipses(center, covariance)
    off = shape[0] - center[0]
    squared = np.einsum("ki,ij,kj->k", off, np.linalg.inv(covariance[0]), off)
    np.testing.assert_allclose(squared, 9.0)
    assert semi[0] == pytest.approx(3 * np.sqrt(np.linalg.eigvalsh(covariance[0])[1]))
    assert np.isnan(semi[1:]).all() and np.isnan(shape[1:]).all()


def test_estimates_outside_change_no_limits_and_are_pointed_at(start: Any) -> None:
    inside = start.render()
    axes = start.engine.top_view._axes
    before = (*axes.get_xlim(), *axes.get_ylim())
    engine = start.engine
    engine.view("estimate_rotation")[0, 0] = np.eye(3)
    for far in (60.0, 1e12, np.nan):
        engine.view("estimate_position")[0, 0] = [far, -16.0, 2.5]
        engine.view("covariance")[0] *= 1e6
        engine.refresh()
        picture = start.render()
        assert (*axes.get_xlim(), *axes.get_ylim()) == before
        edge = picture[:, int(axes.get_window_extent().x1) - 16 : int(axes.get_window_extent().x1) - 2]
        blue = np.all(np.abs(edge - 255 * np.array(to_rgb(vehicle_colour(0)))) < 8, axis=-1).sum()
        assert (blue > 15) == (far > 0), far
    assert np.any(inside != picture)


@pytest.mark.parametrize("name", coopenv.list_envs())
def test_limits_hold_the_whole_prescribed_episode(name: str) -> None:
    scenario = load_scenario(name)
    low, high = limits(scenario)
    engine = Engine(scenario)
    engine.reset([0])
    kinds = [agent.motion.kind for agent in (*scenario.landmarks, *scenario.vehicles)]
    prescribed = [kind not in ("driven", "traffic") for kind in kinds]
    moves = not {*kinds} <= {"driven", "traffic", "static"}
    for _ in range(int(scenario.horizon) if moves else 1):
        position = engine.view("position")[0, prescribed, :2]
        assert np.all((position > low) & (position < high))
        engine.step(ticks=round(scenario.rates.camera))
    assert high[0] - low[0] == pytest.approx(high[1] - low[1])


def test_limits_follow_the_map_origin() -> None:
    low, high = limits(load_scenario(FOUR_WAY))
    moved = limits(load_scenario(FOUR_WAY, {"map.origin": [3.0, -2.0, 0.5]}))
    np.testing.assert_allclose(moved, np.array([low, high]) - [3.0, -2.0])


def test_field_of_view_is_that_of_the_calibration() -> None:
    fan = camera_fan(Camera(model="pinhole"))
    angles = np.degrees(np.arctan2(fan[:, 1], fan[:, 0]))
    assert angles[0] == pytest.approx(np.degrees(np.arctan(154.841998 / 213.161906)))
    assert angles[-1] == pytest.approx(-np.degrees(np.arctan((316 - 154.841998) / 213.161906)))
    np.testing.assert_allclose(np.linalg.norm(fan, axis=1), 1.0)
    np.testing.assert_allclose(fan[:, 2], 0.0, atol=1e-12)


def test_field_of_view_ends_at_walls() -> None:
    wall = Box("wall", np.eye(3), np.array([5.0, 0.0, 1.0]), (2.0, 4.0, 2.0))
    low_wall = Box("low", np.eye(3), np.array([-1.0, 2.0, 0.1]), (9.0, 1.0, 0.2))
    rays = np.array([[[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [np.cos(1.2), np.sin(1.2), 0]]])
    length = free_lengths(np.array([[0.0, 0.0, 0.5]]), rays, 8.0, [wall, low_wall])
    np.testing.assert_allclose(length, [[4.0, 8.0, 8.0, 8.0]])


def test_show_without_a_display_is_silent() -> None:
    """With each setting of Matplotlib's backend, in forks of one interpreter in which Matplotlib is not loaded yet."""
    script = (
        "import os, sys\n"
        "import coopenv.scenario.files, coopenv.estimation, coopenv.episode\n"
        "assert 'matplotlib' not in sys.modules\n"
        "for backend in (None, 'tkagg', 'module://no_such_backend'):\n"
        "    if os.fork() == 0: break\n"
        "    assert os.wait()[1] == 0, backend\n"
        "else: sys.exit()\n"
        "os.environ.update({'MPLBACKEND': backend} if backend else {})\n"
        "import matplotlib as mpl, numpy as np\n"
        "settings = lambda: {k: mpl.rcParams[k] for k in mpl.rcParams if k != 'backend'}\n"
        "before = settings()\n"
        "import coopenv\n"
        "from coopenv.viz import figures\n"
        "from coopenv.viz.topview import TopView\n"
        "view = TopView(coopenv.load_scenario('crossing_path'))\n"
        "assert 'matplotlib.pyplot' not in sys.modules and settings() == before\n"
        "view.show(np.zeros((4, 6, 3), np.uint8)); view.show(np.zeros((4, 6, 3), np.uint8)); view.close()\n"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND")}
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-W", "ignore::DeprecationWarning", "-c", script],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert "matplotlib" not in done.stderr.lower()


def test_window_is_reused_and_stays_away_once_closed_by_the_user(monkeypatch: pytest.MonkeyPatch, start: Any) -> None:
    monkeypatch.setattr(backend_registry, "list_builtin", lambda which: [mpl.get_backend().lower()])
    plt.switch_backend("agg")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    already = set(plt.get_fignums())
    view = TopView(start.scenario)
    picture = view.draw(start.engine)
    view.show(picture)
    (number,) = set(plt.get_fignums()) - already
    view.show(255 - picture)
    assert set(plt.get_fignums()) == {*already, number}
    np.testing.assert_array_equal(plt.figure(number).axes[0].images[0].get_array(), 255 - picture)
    plt.close(number)
    view.show(picture)
    assert set(plt.get_fignums()) == already
    view.close()
    view.show(picture)
    assert len(plt.get_fignums()) == len(already) + 1
    view.close()
    assert set(plt.get_fignums()) == already


def test_without_a_usable_toolkit_the_window_stays_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """Importing it may fail, in whatever way; nothing is asked of it later."""
    monkeypatch.delattr(mpl, "pyplot", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    window = PictureWindow("a window")
    for _ in range(2):
        window.show(np.zeros((4, 4, 3), dtype=np.uint8))
    window.close()


def test_drawn_routes_and_goals_are_where_the_state_says() -> None:
    """A thin line of the vehicle's colour, and the white disc of its goal, in two episodes with other draws."""
    route = {"name": "way", "waypoints": [[-6, 0], [0, 0], [0, 6]], "corner_radius": 3.0, "lateral_spread": 2.0}
    made = scenario([{"routes": ["way"], "motion": {"kind": "driven"}, "goal": {"radius": 0.6}}], routes=[route])
    engine, view = Engine(made), TopView(made)
    seen = []
    for seed in (0, 1):
        engine.reset([seed])
        picture = view.draw(engine)
        x, y, _ = engine.view("route")[0, 0, int(0.6 * engine.view("route_count")[0, 0])]
        around = [at(picture, view, x + dx, y) for dx in np.linspace(-0.05, 0.05, 5)]
        colour = 255 * np.array(to_rgb(vehicle_colour(0)))
        assert min(np.abs(pixel - colour).max() for pixel in around) < 130
        assert at(picture, view, x + 0.4, y + 0.4).min() > 230
        goal_x, goal_y = engine.view("goal")[0, 0, :2]
        assert at(picture, view, goal_x + 0.35, goal_y).min() > 245
        seen.append(picture)
    assert (seen[0] != seen[1]).any()


def test_who_is_absent_is_not_drawn() -> None:
    """Nor is its name; the picture of a world without absent agents has them."""
    group = {"name": "g", "count": 2, "boxes": [{"center": [0, 5], "half": [3, 1]}], "height": [0.5, 1.0]}
    cars = [{"initial_pose": {"position": [x, -3.0, 0.0]}, "presence": 0.5} for x in (-3.0, 3.0)]
    made = scenario(cars, landmarks=[], landmark_groups=[{**group, "presence": 0.5}])
    engine, view = Engine(made), TopView(made)
    seen = set()
    for seed in range(12):
        engine.reset([seed])
        picture = view.draw(engine)
        present = engine.view("present")[0] == 1
        for i in (2, 3):
            x, y, _ = engine.view("start_position")[0, i]
            assert (at(picture, view, x + 0.05, y).min() < 200) == present[i]
        for i in (0, 1):
            x, y, _ = engine.view("position")[0, i]
            assert (at(picture, view, x, y)[2] < 150) == present[i]
        seen |= {*zip(range(4), present.tolist(), strict=True)}
    assert len(seen) == 8


@pytest.mark.parametrize("name", ["busy_intersection", "overtaking", "urban_crossing"])
def test_vehicles_point_where_they_go(name: str) -> None:
    """The drawn front, carried along by the true pose, lies ahead on the way that the vehicle then takes."""
    engine, view = drawn(name)
    L = len(view.scenario.landmarks)
    for _ in range(round(30 * engine.backend.scenario.rates.camera / 10)):
        before = np.array(engine.view("position")[0, L:, :2])
        rotation = np.array(engine.view("rotation")[0, L:])
        engine.step(ticks=10)
        moved = np.array(engine.view("position")[0, L:, :2]) - before
        fast = np.linalg.norm(moved, axis=1) > 0.02
        nose = view._nose.mean(axis=1) - view._box.mean(axis=1)
        front = np.einsum("nij,nj->ni", rotation[:, :2, :2], nose)
        ahead = np.sum(front * moved, axis=1) / np.linalg.norm(front, axis=1) / np.linalg.norm(moved, axis=1).clip(1e-9)
        assert (ahead[fast] > 0.9).all()
        if fast.all():
            break
    assert fast.any() or name == "urban_crossing"  # nobody drives there by itself


def test_goals_that_touch_share_a_name() -> None:
    center = np.array([[0, 0], [5, 0], [1.5, 0], [2.9, 0], [np.nan, 0], [0, 9]])
    assert touching(center, np.full(6, 0.8)) == [[1], [0, 2, 3], [5]]
    _, view = drawn("large_crossing")
    names = [name for name in view._goals._names if name.get_text()]
    assert 1 < len(names) < 16
    boxes = [name.get_window_extent() for name in names]
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    map_box = view._axes.get_window_extent()
    assert all(map_box.x0 <= box.x0 and box.x1 <= map_box.x1 for box in boxes)


@pytest.mark.parametrize("name", ["busy_intersection", "large_crossing", "svea_overtaking"])
def test_names_stand_beside_their_vehicles(name: str) -> None:
    _, view = drawn(name)
    for label, body in zip(view._names, view._truth.get_paths(), strict=True):
        corners = view._axes.transData.transform(body.vertices[:4])
        if not np.isfinite(corners).all():  # is not there
            continue
        text = label.get_window_extent()
        apart = [text.x0 - corners[:, 0].max(), corners[:, 0].min() - text.x1]
        apart += [text.y0 - corners[:, 1].max(), corners[:, 1].min() - text.y1]
        assert max(apart) > -2.0, label.get_text()  # px


def test_the_title_of_a_map_alone_ends_where_the_error_begins() -> None:
    made = load_scenario("busy_intersection", {"title": "Busy intersection, with a mirrored start and more"})
    _, view = drawn(made, panel=False)
    assert view._figure.texts[0].get_window_extent().x1 < view._time.get_window_extent().x0


def test_names_of_goals_do_not_cover_those_of_landmarks() -> None:
    """A landmark's name stands where a goal's would be: in the goal, and, of the other one, to its right."""
    landmarks = [{"name": "P1", "position": [3.6, 4.0, 1.0]}, {"name": "P2", "position": [-2.7, -4.0, 1.0]}]
    goals = [{"position": [4.0, 4.2, 0.0], "radius": 1.0}, {"position": [-4.0, -3.8, 0.0], "radius": 0.3}]
    starts = [{"position": [0.0, -8.0, 0.0]}, {"position": [0.0, 8.0, 0.0]}]
    vehicles = [
        {"initial_pose": start, "motion": {"kind": "driven"}, "goal": goal}
        for start, goal in zip(starts, goals, strict=True)
    ]
    _, view = drawn(scenario(vehicles, landmarks=landmarks))
    texts = {text.get_text(): text.get_window_extent() for text in view._axes.texts if text in view._layers._artists}
    shown = [name for name in view._goals._names if name.get_text()]
    assert len(shown) == 2
    for name in shown:
        for landmark in ("P1", "P2"):
            assert not name.get_window_extent().overlaps(texts[landmark])
