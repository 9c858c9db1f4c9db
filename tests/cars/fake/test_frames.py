"""`sensing = "images"`: bearings of a vehicle come from rendered frames with tags, by the detector of tags."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import coopenv
from coopenv import CoopenvError
from coopenv.cars.fake.frames import FrameRenderer, PlacedTag, facing
from coopenv.cars.messages.vision import Calibration, dictionary_of, opencv
from coopenv.observers.sensed import Sensed
from coopenv.scenario import Scenario, parse_scenario
from coopenv.sources.base import Command
from coopenv.sources.sources import simulation_of

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "rendered_frames.toml"
CAMERA = {
    **{"model": "pinhole", "position": [0.3, 0.0, 0.3], "image_size": [320, 240], "principal_point": [161.0, 118.0]},
    **{"focal_length": [225.0, 227.0], "distortion": [-0.3, 0.1, 0.002, 0.0006, 0.0]},
}
IN_VIEW = {"a": [4.0, 1.2, 0.6], "b": [4.0, -1.2, 0.7], "c": [4.5, 0.1, 1.7]}
OCCLUDED = {"by_building": [7.0, -1.0, 0.7], "by_vehicle": [4.5, 0.0, 0.1]}
BEHIND = {f"behind_{n}": [-4.0, n - 1.5, 0.5] for n in range(4)}
COARSE = {
    **{
        "rates.camera": 10.0,
        "camera.image_size": [320, 240],
        "camera.focal_length": [225.0, 227.0],
        "images.side": 0.5,
    },
    "camera.principal_point": [161.0, 118.0],
}
"""Of the example: frames that are searched in a quarter of the time."""
AHEAD = 2.5  # m, of the second vehicle


def yard(marks: dict[str, Any], **more: Any) -> Scenario:
    """Return two vehicles, one behind the other, that stand before landmarks; the second has no landmark in view."""
    car = {"motion": {"kind": "driven"}, "body": {"size": [0.6, 0.3, 0.3], "center": [0.1, 0.0, 0.15]}}
    raw = {
        **{"title": "yard", "horizon": 10.0, "sensing": "images", "camera": CAMERA},
        "images": {"side": 0.4, **more.pop("images", {})},
        "rates": {"camera": 10.0, "decision": 10.0, "odometry": 100.0},
        "topology": {"mode": "sensed", "acyclic": False},
        "landmarks": [{"name": name, "position": place} for name, place in marks.items()],
        "obstacles": [{"name": "wall", "center": [5.5, -1.0, 1.0], "size": [0.2, 0.9, 2.0]}],
        "vehicles": [
            {**car, "initial_pose": {"position": [x, 0.0, 0.0], "yaw": yaw}, "marker": [0.0, 0.0, 0.5]}
            for x, yaw in ((0.0, 0.05), (AHEAD, 3.1))
        ],
    }
    return parse_scenario({**raw, **more}, "yard")


def ticks(scenario: Scenario, count: int, pan: float = 0.0, speed: float = 0.0) -> list[Sensed]:
    """Return the ticks of an episode of two vehicles."""
    backend, zeros = simulation_of(scenario), np.zeros(2)
    found = [backend.reset(1, {})]
    while len(found) < count:
        found += backend.advance(Command(zeros + speed, zeros, zeros + 1.0, zeros + pan))
    return found


class TestWithDetector:
    """Needs OpenCV."""

    @pytest.fixture(autouse=True)
    def _opencv(self) -> None:
        pytest.importorskip("cv2", reason="needs the extra 'vision'")

    @pytest.mark.parametrize("pan", [0.0, 0.15])
    def test_bearings_are_those_of_the_geometry(self, pan: float) -> None:
        turning = {"action": {"pan": {"limit": 0.5, "rate": 1.0}}} if pan else {}
        scenario = yard({**IN_VIEW, **OCCLUDED}, **turning)
        frames = ticks(scenario, 12, pan, speed=0.2)
        names, lens = scenario.target_names, np.array(CAMERA["position"])
        seen = [{names[target] for target in np.flatnonzero(frame.visible[0])} for frame in frames]
        assert [*IN_VIEW, "vehicle_2"] == sorted(set().union(*seen)) and sum(map(len, seen)) >= 44
        for frame in frames:
            assert frame.truth is not None
            R, p = frame.truth.rotation, frame.truth.position
            points = np.concatenate([frame.landmarks, p + R @ scenario.vehicles[0].marker])
            for i in range(2):
                rays = (points - p[i]) @ R[i] - lens
                rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
                there = frame.visible[i]
                off = np.linalg.norm(frame.bearings[i, there] - rays[there], axis=-1)
                assert np.degrees(off).max(initial=0.0) < 0.1
        assert frames[-1].pan is None or frames[-1].pan[0] == pytest.approx(pan)

    @pytest.mark.parametrize("pan", [0.0, 0.3])
    def test_tags_are_drawn_where_the_targets_are(self, monkeypatch: pytest.MonkeyPatch, pan: float) -> None:
        drawn: list[list[PlacedTag]] = []

        def kept(renderer: FrameRenderer, tags: list[PlacedTag], *shades: Any) -> np.ndarray:
            drawn.append(tags)
            return render(renderer, tags, *shades)

        render = FrameRenderer.render
        monkeypatch.setattr(FrameRenderer, "render", kept)
        turning = {"action": {"pan": {"limit": 0.5, "rate": 1.0}}} if pan else {}
        scenario = yard(IN_VIEW, map={"origin": [1.0, 2.0, 0.5]}, **turning)
        frame = ticks(scenario, 6, pan, speed=0.3)[-1]
        assert frame.truth is not None and [tag.number for tag in drawn[-2]] == [0, 1, 2, 4]
        (R, *_), (p, *_) = frame.truth.rotation, frame.truth.position
        places = np.concatenate([frame.landmarks, frame.truth.position[1:] + scenario.vehicles[1].marker])
        angle = 0.0 if frame.pan is None else frame.pan[0]
        turned = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
        optical = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # x right, y down, z forward
        offsets = ((places - p) @ R - CAMERA["position"]) @ turned @ optical.T
        assert np.allclose([tag.place for tag in drawn[-2]], offsets, rtol=0.0, atol=1e-6)
        assert all(tag.side == 0.4 for tag in drawn[-2]) and np.ptp(np.linalg.norm(offsets, axis=1)) > 1.0
        for tag in drawn[-2]:  # upright, and towards the camera
            assert np.allclose(tag.axes[:, 1], [0, 1, 0]) and abs(tag.axes[:, 0] @ tag.place) < 1e-9
            assert np.linalg.det(tag.axes) == pytest.approx(1.0) and tag.axes[:, 2] @ tag.place > 0.0

    @pytest.mark.parametrize("x", [-2.2, -1.9, -1.1, 0.0, 0.8, 2.0])
    @pytest.mark.parametrize("y", [-1.5, 0.1, 1.55])
    def test_a_tag_is_painted_whole_up_to_the_edges_of_the_image(
        self, monkeypatch: pytest.MonkeyPatch, x: float, y: float
    ) -> None:
        renderer = FrameRenderer(Calibration.of(yard(IN_VIEW).cameras[0]), "tag16h5")
        tag = facing(3, np.array([x, y, 3.0]), 0.7)

        def frame() -> np.ndarray:
            return renderer.render([tag], 0.0, 0.0, np.random.default_rng(0))

        painted = frame()
        monkeypatch.setattr(renderer, "_box", lambda *_: (slice(0, 240), slice(0, 320)))
        assert np.array_equal(painted, frame())

    def test_a_family_may_have_exactly_as_many_tags_as_there_are_targets(self) -> None:
        simulation_of(yard({f"m{n}": [4.0, 0.1 * n, 0.5] for n in range(28)}))

    def test_a_tag_outside_the_image_or_unreadable_is_missed(self) -> None:
        assert not any(frame.visible.any() for frame in ticks(yard(IN_VIEW, images={"blur": 12.0}), 3))
        small = ticks(yard(IN_VIEW, images={"side": 0.02}), 3)
        assert not any(frame.visible.any() for frame in small)

    def test_identities_are_lost_and_wrong_at_their_rates(self) -> None:
        lost, wrong = 0.2, 0.3
        camera = {**CAMERA, "miss_probability": lost}
        scenario = yard({**IN_VIEW, **BEHIND}, images={"wrong_identity": wrong}, camera=camera)
        frames = ticks(scenario, 70)
        visible = np.array([frame.visible[0, : len(scenario.landmarks)] for frame in frames])
        right, taken = (1.0 - lost) * (1.0 - wrong), (1.0 - lost) * wrong / 7  # a number of seven others
        assert visible[:, :3].mean() == pytest.approx(1.0 - (1.0 - right) * (1.0 - taken) ** 3, abs=0.05)
        assert visible[:, 3:].mean() == pytest.approx(1.0 - (1.0 - taken) ** 4, abs=0.03)  # four tags are in view
        steady = ticks(yard({**IN_VIEW, **BEHIND}, noise={"enabled": False}, images={"wrong_identity": 1.0}), 3)
        assert all(frame.visible[0].tolist() == [True] * 3 + [False] * 5 + [True] for frame in steady)

    @pytest.mark.parametrize("observer", ["riccati", "robust"])
    def test_estimators_converge(self, observer: str) -> None:
        changes = {"observer.name": observer, "images.wrong_identity": 0.0, "horizon": 3.0, **COARSE}
        env = coopenv.parallel_env(EXAMPLE, overrides=changes, dtype="float64")
        env.reset(seed=2)
        while env.agents:
            *_, infos = env.step({agent: np.array([0.0, 0.0]) for agent in env.agents})
        assert all(info["position_error"] < 0.1 for info in infos.values())

    def test_an_episode_goes_on_from_a_saved_state(self) -> None:
        env = coopenv.parallel_env(EXAMPLE, overrides={"images.wrong_identity": 0.3, **COARSE})
        env.reset(seed=4)
        actions = {agent: np.array([0.3, 0.0]) for agent in env.agents}
        env.step(actions)
        twin = coopenv.parallel_env(EXAMPLE, overrides={"images.wrong_identity": 0.3, **COARSE})
        twin.reset(seed=9)
        twin.set_state(env.get_state())
        for _ in range(2):
            first, second = env.step(actions)[0], twin.step(actions)[0]
            assert all((first[agent] == second[agent]).all() for agent in actions)

    @pytest.mark.parametrize("chosen", [{"num_worlds": 2}, {"num_worlds": 1, "device": "cuda"}])
    def test_one_world_on_the_cpu(self, chosen: dict[str, Any]) -> None:
        with pytest.raises(CoopenvError, match=r"^sensing: 'images' renders one world on the CPU: "):
            coopenv.make_vec(EXAMPLE, **chosen)

    def test_a_family_with_too_few_tags(self) -> None:
        marks = {f"m{n}": [4.0, 0.1 * n, 0.5] for n in range(29)}
        with pytest.raises(CoopenvError, match=r"^images\.family: tag16h5 has 30 tags, the scenario has 31 targets$"):
            simulation_of(yard(marks, images={"family": "tag16h5"}))


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"images.family": "tag36h12"}, r"images\.family: unknown family 'tag36h12'"),
        ({"images.side": 0.0}, r"images\.side"),
        ({"images.noise": 300.0}, r"images\.noise"),
        ({"images.wrong_identity": 1.5}, r"images\.wrong_identity"),
        (
            {"topology.mode": "fixed"},
            r"'images' needs topology\.mode = 'sensed' without topology\.most_nearby",
        ),
        (
            {"camera.quantise": True},
            r"'images' needs camera\.model = 'pinhole', quantise = false and undistort = true",
        ),
        ({"camera.image_size": [4000, 3000]}, r"camera\.image_size of at most 2,097,152 pixels, not so for vehicle_1"),
        ({"randomisation.bearing_noise": [1.0, 2.0]}, r"randomisation\.bearing_noise: the errors of rendered frames"),
        ({"vehicles": [{"routes": ["south"]}] * 17}, r"sensing: 'images' needs at most 16 vehicles, got 17"),
    ],
)
def test_settings_that_do_not_fit(changes: dict[str, Any], line: str) -> None:
    with pytest.raises(CoopenvError, match=line) as error:
        coopenv.load_scenario(EXAMPLE, changes)
    assert "\n" not in str(error.value)


def test_a_factor_of_bearing_noise_is_refused() -> None:
    env = coopenv.parallel_env(EXAMPLE)
    with pytest.raises(CoopenvError, match=r"^parameters: bearing_noise: the errors of rendered frames are the det"):
        env.reset(seed=0, options={"parameters": {"bearing_noise": 2.0}})
    env.reset(seed=0, options={"parameters": {"odometry_noise": 2.0}})


def test_without_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    opencv.cache_clear()
    dictionary_of.cache_clear()
    scenario = coopenv.load_scenario(EXAMPLE)  # can be described without it
    with pytest.raises(CoopenvError, match=r"^tags in images need an extra: .*vision.*$"):
        simulation_of(scenario)
