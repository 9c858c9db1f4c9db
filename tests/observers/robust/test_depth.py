"""Consistency: errors are as large as covariances say, along chains, where vehicles meet again, in drawn scenes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.linalg import eigvalsh

from coopenv.observers.bound import cramer_rao_ancestors
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario
from coopenv.world.world import World
from tests.helpers.builders import reset, simulate
from tests.helpers.env_suite import rest_slow
from tests.helpers.recordings import completed
from tests.helpers.robust_worlds import SMALL_ERRORS, nees_of, steps_of, watched

SEEDS = range(5200, 5232)
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "tracking": ("busy_intersection_tracking", {}),
    "a lane": ("lane:5", {}),
    "a lane in which each sees three": ("lane:6,seen=3", {}),
    "a drawn graph": ("random:7,seed=521", {}),
    "a tree": ("tree:7", {}),
    "messages that are late, stale and lost": ("lane:4", {"v2x.delay": 3, "v2x.loss": 0.4, "v2x.period": 2}),
    "slow corrections": ("lane:4", {"rates.observer": 25.0, "rates.odometry": 37.0}),
    "a scale error and a bias": ("lane:4", {"noise.odometry_scale": 0.03, "noise.gyro_bias": [0.0, 0.0, 0.0087]}),
    "errors that walk": ("lane:4", {"noise.odometry_scale_walk": 0.003, "noise.gyro_bias_walk": 0.001}),
    "clocks that are off": ("lane:4", {"faults.clock_offset": 0.05}),
    "a turned camera": (
        "busy_intersection_tracking",
        {"camera.extrinsics_error": 0.02, "camera.extrinsics_position_error": 0.02},
    ),
}
EXPECTED = {"a turned camera": (0.7, 1.2)}
"""Least and most of ANEES where the errors that are estimated with the pose are not small."""


@pytest.mark.parametrize("scene", rest_slow(SCENES, 0, 3, 5, 7, 10))
def test_errors_are_as_large_as_their_covariances_say(scene: str) -> None:
    name, overrides = SCENES[scene]
    made = load_scenario(name, {"observer.name": "robust", "horizon": 13.0, **overrides})
    nees = watched(made, SEEDS, 12, round(made.rates.camera), skipped=3, dtype="float32")[0]
    nees = np.nanmean(nees, axis=0)  # of each vehicle
    mean, error = nees.mean(axis=0), nees.std(axis=0, ddof=1) / np.sqrt(len(nees))
    least, most = EXPECTED.get(scene, (0.7, 1.05))
    assert (mean - 3.0 * error < most).all(), (mean, error)
    assert (mean + 3.0 * error > least).all(), (mean, error)


@pytest.mark.parametrize("name", rest_slow(["busy_intersection_tracking", "lane:4", "random:6,seed=521"], 0, 2))
def test_no_vehicle_knows_more_than_there_is(name: str) -> None:
    """Its covariance is no smaller, in any direction, than the bound over it and all whose messages can reach it."""
    overrides = {"horizon": 8.0, "noise.bearing.model": "isotropic", **SMALL_ERRORS}
    recording = record(load_scenario(name, overrides), 5)
    result, bound = completed("robust", recording), cramer_rao_ancestors(recording)
    for k in range(100, recording.ticks, 60):
        for i in range(len(recording.setups)):
            least = eigvalsh(result.covariance[k, i], bound.covariance[k, i])[0]
            assert least > 0.9, (k, i, least)
    assert (result.bytes_per_second * recording.period * recording.dt <= 8 * 28 * 1.001).all()  # in the mean
    size = [np.trace(P[-60:, :, 3:, 3:], axis1=2, axis2=3).mean(axis=0) for P in (result.covariance, bound.covariance)]
    assert (size[0] < 2.5 * size[1]).all(), size[0] / size[1]


EDGES = (2, 5, 10, 20, 35, 60)  # s
DEEP = {
    "`lane:8`": ("lane:8", {}),
    "`lane:8`, messages 50 ms late": ("lane:8", {"v2x.delay": 3}),
    "`lane:8`, 30 % of messages lost": ("lane:8", {"v2x.loss": 0.3}),
    "`lane:20`": ("lane:20", {}),
    "`tree:20`": ("tree:20", {}),
    "`random:16,seed=7`": ("random:16,seed=7", {}),
    "`random:50,seed=9`": ("random:50,seed=9", {}),
    "`roots:10`": ("roots:10", {}),
    "`roots:14`": ("roots:14", {}),
    "`roots:14`, scale off by 10 %, little noise": ("roots:14", {"noise.velocity": 0.02, "noise.odometry_scale": 0.1}),
    "`lane:14,seen=5`, scale off by 5 %": ("lane:14,seen=5", {"noise.odometry_scale": 0.05}),
    "`ring:5`": ("ring:5", {}),
}


def by_window(
    name: str, overrides: dict[str, float], seeds: range, edges: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return (windows, W, N) the mean NEES/6 and (windows, N) the RMS position error, m, between seconds."""
    made = load_scenario(name, {"observer.name": "robust", "horizon": float(edges[-1]) + 1.0, **overrides})
    half = round(made.rates.camera) // 2
    nees, errors, _ = watched(made, seeds, 2 * edges[-1], half, skipped=2 * edges[0])
    windows = 2 * (np.array(edges[1:-1]) - edges[0])
    means = [part.mean(axis=0) for part in np.split(nees, windows)]
    return np.array(means), np.array([np.sqrt((part**2).mean(axis=(0, 1))) for part in np.split(errors, windows)])


@pytest.mark.parametrize(
    ("name", "overrides", "most"),
    rest_slow(
        [
            ("lane:8", {}, 2.0),
            ("random:12,seed=4", {}, 2.0),
            ("ring:5", {}, 1.6),
            ("roots:12", {"noise.velocity": 0.01, "noise.odometry_scale": 0.1}, 1.6),
            ("lane:12,seen=5", {"noise.odometry_scale": 0.05}, 1.6),
            ("lane:8", {"v2x.delay": 12, "noise.velocity": 0.15, "noise.bearing.scale": 0.0005}, 1.6),
        ],
        0,
        2,
        3,
    ),
    ids=str,
)
def test_everybody_is_as_sure_as_it_may_be(name: str, overrides: dict[str, float], most: float) -> None:
    """Starts of up to 10 degrees and 1 m; the mean over worlds of each vehicle.

    Also in circles, with wheels that are off by a tenth, with many to hear, and with late messages: up to 12 was seen
    where errors of odometry that last were taken for what senders had learnt.
    """
    anees = by_window(name, overrides, range(12), (2, 5, 10, 15))[0].mean(axis=1)
    assert (anees > 0.3).all() and (anees < most).all(), anees


def test_a_vehicle_at_the_end_of_a_lane_finds_its_place() -> None:
    """The eighth and the twelfth: 0.09 and 0.2 m were seen, 0.15 and 0.9 m with linearisations said to err less."""
    _, errors = by_window("lane:20", {}, range(6), (10, 15))
    assert errors[0, 7] < 0.2 and errors[0, 11] < 0.4


@pytest.mark.slow
@pytest.mark.parametrize("title", DEEP)
def test_how_sure_it_is_in_other_worlds(title: str) -> None:
    name, overrides = DEEP[title]
    anees, errors = by_window(name, overrides, range(700, 716), EDGES)
    mean = anees.mean(axis=1)
    worst = mean.argmax(axis=1)
    spread = anees.std(axis=1, ddof=1) / np.sqrt(anees.shape[1])
    parts = [
        f"{mean[k].min():.2f} .. {mean[k, n]:.2f}({spread[k, n]:.2f}) {100 * np.median(errors[k]):.1f} "
        f"{100 * errors[k].max():.1f}"
        for k, n in enumerate(worst)
    ]
    print(f"\n{title}: ANEES least .. worst, error median and largest, cm: " + " | ".join(parts))
    assert (mean > 0.3).all() and (mean < 3.0).all()


ROBUST = {"observer.name": "robust"}


def lane(name: str, **overrides: float) -> World:
    world = simulate(load_scenario(name, ROBUST | {"horizon": 3.0} | overrides), 2)
    reset(world)
    return world


def test_it_depends_on_those_that_it_has_heard() -> None:
    world = lane("lane:5,seen=2")
    memory: Any = world.memory
    world.advance(0)
    assert (memory.belief.numpy()["depends_on"] <= [0, 0b1, 0b11, 0b110, 0b1100]).all()  # at most on first messages
    world.advance(60)
    assert (memory.belief.numpy()["depends_on"] == [0, 0b1, 0b11, 0b111, 0b1111]).all()


def test_nobody_depends_on_who_is_not_heard() -> None:
    world = lane("lane:5,seen=2", **{"v2x.loss": 0.999999})
    world.advance(60)
    memory: Any = world.memory
    assert (memory.belief.numpy()["depends_on"] == 0).all()
    assert np.isfinite(world.view("estimate_position")).all() and np.isfinite(world.view("covariance")).all()


def test_nobody_in_a_lane_is_met_again() -> None:
    world = lane("lane:6,seen=3")
    memory: Any = world.memory
    for _ in range(20):
        world.advance(6)
        assert (memory.member.numpy()["correlation_unknown"] == 0).all()


def meeting(worlds: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ANEES (W,), the position error (W,) in m and how often a member in view is marked, sixteen cars."""
    found, marked = [], []
    for engine in steps_of("route_follower", load_scenario("large_crossing", ROBUST), worlds, 3):
        found.append(nees_of(engine.world))
        memory: Any = engine.world.memory
        marked.append(memory.member.numpy()["correlation_unknown"].mean())
    nees, errors = (np.array(part)[15:] for part in zip(*found, strict=True))
    return np.nanmean(nees, axis=(0, 2)), np.sqrt(np.nanmean(errors**2, axis=(0, 2))), np.array(marked)


@pytest.mark.slow
def test_cars_that_meet_again_and_again_know_how_well_they_stand() -> None:
    """Their ANEES grew up to 3 and more while strangers' errors counted as independent."""
    nees, errors, marked = meeting(16)
    mean, std = nees.mean(), nees.std() / np.sqrt(len(nees))
    print(f"\nlarge_crossing: ANEES {mean:.2f} +- {std:.2f}, {100 * errors.mean():.0f} cm, marked {marked.mean():.3f}")
    assert marked.max() > 0.0
    assert mean - 2.0 * std < 1.3


WINDOWS = ((5, 10), (10, 20), (20, 40))  # s
WORLDS = 8


class Drawn(NamedTuple):
    """A scene, and how it is changed."""

    name: str
    overrides: dict[str, Any]
    scale: float  # of all lengths and speeds
    turn: float  # rad, of the start
    offset: float  # m, likewise


def draw(number: int) -> Drawn:
    """Return the scene of a number."""
    random = np.random.default_rng(77000 + number)

    def between(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    kind = str(random.choice(["lane", "roots", "tree", "random", "random", "ring"]))
    name = f"{kind}:{random.integers(4, 25)}"
    if kind in ("lane", "tree", "random"):
        name += f",seen={random.integers(2, 6)}"
    if kind == "ring":
        name += f",seen={random.integers(1, 3)}"
    if kind == "random":
        name += f",seed={random.integers(1000)}"
    camera = float(random.choice([10, 15, 20, 30, 60]))
    overrides: dict[str, Any] = {
        "rates.camera": camera,
        "rates.odometry": float(random.choice([10, 20, 50, 100, camera])),
        "rates.decision": 5.0,
        "noise.velocity": between(0.02, 0.4),
        "noise.angular_velocity": between(0.002, 0.05),
        "noise.bearing.scale": between(0.0005, 0.02),
        "v2x.period": int(max(1, round(camera * between(0.03, 0.5)))),
        "v2x.delay": int(random.choice([0, 1, round(camera * 0.1), round(camera * 0.2)])),
        "v2x.loss": float(random.choice([0.0, 0.0, 0.1, 0.3, 0.5])),
    }
    for key, chance, low, high in (
        ("noise.gyro_bias", 0.3, 0.003, 0.03),
        ("noise.odometry_scale", 0.3, 0.01, 0.06),
        ("camera.extrinsics_error", 0.2, 0.003, 0.03),
    ):
        if random.random() < chance:
            overrides[key] = between(low, high)
    if random.random() < 0.2:
        overrides["camera.position"] = random.uniform(-1.0, 1.0, 3).tolist()
    scale = between(0.5, 20.0)
    return Drawn(name, overrides, scale, between(0.02, 0.35), between(0.1, 2.0) * max(1.0, scale**0.5))


def built(drawn: Drawn) -> Scenario:
    """Return the scenario of a drawn scene."""
    raw = load_scenario(drawn.name, {"observer.name": "robust", "horizon": 41.0, **drawn.overrides}).model_dump()

    def longer(values: Any) -> tuple[float, ...]:
        return tuple(drawn.scale * value for value in values)

    for mark in raw["landmarks"]:
        mark["position"] = longer(mark["position"])
    for vehicle in raw["vehicles"]:
        for part in (vehicle["motion"], *vehicle["motion"].get("segments", ())):
            if "linear" in part:
                part["linear"] = longer(part["linear"])
        vehicle["initial_pose"]["position"] = longer(vehicle["initial_pose"]["position"])
        vehicle["initial_estimate"] |= {"orientation_angle": drawn.turn, "position_radius": drawn.offset}
    return Scenario(**raw)


def consistency(drawn: Drawn) -> np.ndarray:
    """Return (windows, W, N) the mean NEES/6; NaN where a vehicle never knows its pose."""
    half = int(drawn.overrides["rates.camera"]) // 2
    at = np.arange(1, 81) * half / drawn.overrides["rates.camera"]
    nees = watched(built(drawn), range(31000, 31000 + WORLDS), len(at), half)[0]
    parts = [nees[(at > start) & (at <= end)] for start, end in WINDOWS]
    counts = [np.isfinite(part).sum(axis=0) for part in parts]
    return np.array([np.nansum(p, axis=0) / np.where(n > 0, n, np.nan) for p, n in zip(parts, counts, strict=True)])


def test_noise_of_odometry_is_no_error_of_its_scale() -> None:
    """Four vehicles, a third as much noise as speed: the scale seemed to be off by a sixth, ANEES was 3.4."""
    anees = np.nanmean(consistency(draw(557)), axis=1)
    assert (anees > 0.4).all() and (anees < 1.6).all(), anees


@pytest.mark.slow
def test_it_is_consistent_in_scenes_that_nobody_chose() -> None:
    """Some vehicles far down a large graph are surer than they may be, few by much."""
    typical, worst = [], []
    for number in range(500, 560):
        drawn = draw(number)
        anees = np.nanmean(consistency(drawn), axis=1)
        typical.append(np.nanmedian(anees, axis=1))
        worst.append(np.nanmax(anees, axis=1))
        print(f"\n{number} {drawn.name}: largest ANEES {worst[-1].round(2)}, median {typical[-1].round(2)}", end="")
    print(f"\nmedian over scenes of the median {np.median(typical, axis=0).round(2)}", end="")
    print(f", of the largest {np.median(worst, axis=0).round(2)}; above 2: {(np.array(worst) > 2.0).mean(axis=0)}")
    assert (np.abs(np.median(typical, axis=0) - 1.0) < 0.2).all()
    assert (np.array(worst) > 2.0).mean() < 0.25
