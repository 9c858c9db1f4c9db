"""Clocks of topics: against stamps, motions and bags whose offsets are known by construction."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from coopenv import DataError
from coopenv.base.errors import DataWarning
from coopenv.cars.bags.bag import Bag
from coopenv.cars.bags.clocks import SampledSignal, delay_of, jumps, lead_of_bearings, lead_of_motion, outlying, turn_of
from coopenv.observers import Recording, run
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers import bags
from tests.helpers.env_suite import rest_slow

pytest.importorskip("rosbags", reason="needs the extra 'log'")

S = 1_000_000_000


@given(
    share=st.floats(0.0, 0.1),
    wrong=st.one_of(st.floats(0.2, 1e4), st.floats(-1e4, -0.3)),
    rate=st.sampled_from([10.0, 60.0, 200.0]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=30)
def test_wrong_stamps_are_found_and_no_others(share: float, wrong: float, rate: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = (np.arange(600) / rate * S).astype(np.int64) + 10**15
    received = np.maximum.accumulate(true + (rng.exponential(0.005, 600) * S).astype(np.int64))
    off = (rng.random(600) < share) & (np.arange(600) > (0 if wrong > 0.0 else 20))
    assert_array_equal(outlying(true + off * round(wrong * S), received), off)


def test_a_recorder_that_stalls_drops_nothing() -> None:
    true = np.arange(0, 20 * S, S // 50)
    received = np.where((true > 5 * S) & (true < 7 * S), 7 * S, true + S // 500)
    assert not outlying(true, received).any()
    assert delay_of(true, received).offset == S // 500


@pytest.mark.parametrize(("offset", "drift"), [(3.0, 0.0), (-0.2, 1e-3), (0.0, -5e-5)])
def test_offset_and_drift_of_a_clock(offset: float, drift: float) -> None:
    rng = np.random.default_rng(1)
    true = np.arange(0, 60 * S, S // 100)
    received = true + (0.002 * S + rng.exponential(0.004, len(true)) * S).astype(np.int64)
    found = delay_of(true - round(offset * S) - np.round(drift * (true - 30 * S)).astype(np.int64), received)
    assert found.offset * 1e-9 == pytest.approx(offset + 0.002, abs=1e-3)
    assert found.drift == pytest.approx(drift, abs=1e-5) and not found.jump
    stepped = delay_of(np.where(true > 30 * S, true + S // 2, true), received)
    assert stepped.jump * 1e-9 == pytest.approx(0.5, abs=0.01)


@given(
    jump=st.one_of(st.none(), st.floats(0.1, 1e3), st.floats(-1e3, -0.1)),
    late=st.booleans(),
    rate=st.sampled_from([10.0, 60.0, 200.0]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40)
def test_a_jump_of_the_clock_is_found_and_a_longer_transport_is_no_jump(
    jump: float | None, late: bool, rate: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    true = np.cumsum((1.0 + 0.05 * rng.uniform(-1.0, 1.0, 900)) / rate * S).astype(np.int64)
    true = true[rng.random(900) > 0.03]
    received = true + (rng.exponential(0.003, len(true)) * S).astype(np.int64)
    received[len(true) // 4 :] += late * S // 3  # from there on it takes a third of a second
    k, stamps = int(rng.integers(len(true) // 2, len(true) - 60)), true.copy()
    stamps[k:] += round((jump or 0.0) * S)
    stamps[k + 7 :: 100] += 5 * S
    found = jumps(stamps, np.maximum.accumulate(received))
    if jump is None:
        assert not found
    else:
        [(first, behind)] = found.items()
        assert abs(first - k) <= 1 and behind / S == pytest.approx(-jump, abs=0.01)


def heading(t: np.ndarray | float) -> np.ndarray:
    """Heading of a car on a circle's arc that sways, rad."""
    return np.asarray(0.1 * t + 0.4 * np.sin(0.9 * t) + 0.2 * np.sin(0.37 * t + 1.0))


def turning(t: np.ndarray) -> np.ndarray:
    """Its turn rate."""
    return np.asarray(0.1 + 0.36 * np.cos(0.9 * t) + 0.074 * np.cos(0.37 * t + 1.0))


@pytest.mark.parametrize("offset", [-0.5, -0.05, 0.0, 0.13, 0.45])
def test_leads_of_gyro_and_camera(offset: float) -> None:
    """The car turns on the spot, so that bearings are known in closed form; the gyro has a bias and a wrong scale."""
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 25.0, 0.005)
    gyro = SampledSignal.of_rates(t - offset, 1.03 * turning(t) + 0.02 + rng.normal(0.0, 0.02, len(t)))
    frames = np.arange(0.02, 25.0, 1 / 30)
    truth = SampledSignal(t[::2], np.column_stack([0.0 * t[::2], 0.0 * t[::2], heading(t[::2])]))
    found = lead_of_motion(gyro, SampledSignal(t[::2], heading(t[::2]) + rng.normal(0.0, 0.002, len(t[::2]))))
    assert found is not None and abs(found.seconds - offset) < max(0.003, 4.0 * found.error) < 0.02
    places = np.array([[3.0, 1.0], [-2.0, 2.0], [1.0, -4.0]])
    rows = [(time, np.arctan2(y, x) - heading(time), x, y) for time in frames for x, y in places]
    times, azimuths, x, y = np.array(rows).T
    azimuths += rng.normal(0.0, 0.005, len(azimuths))
    azimuths[::50] += 1.0  # false blocks
    seen = lead_of_bearings(times - offset, azimuths, np.column_stack([x, y]), np.zeros(2), truth)
    assert seen is not None and seen.seconds == pytest.approx(offset, abs=0.003)
    turned = turn_of(times, azimuths, np.column_stack([x, y]))
    assert turned is not None
    against = lead_of_motion(gyro, turned)
    assert against is not None and against.seconds == pytest.approx(offset, abs=0.015)


@pytest.mark.parametrize(("period", "offset"), [(0.85, 0.25), (0.72, -0.15), (0.6, 0.35), (1.23, 0.23)])
def test_a_motion_that_nearly_repeats_itself_has_the_lead_of_its_own_and_not_a_period_more(
    period: float, offset: float
) -> None:
    """Minima of the cost stand a period apart, and each is narrow."""
    t, rng = np.arange(0.0, 30.0, 0.01), np.random.default_rng(5)

    def turned(time: np.ndarray) -> np.ndarray:
        return np.sin(2 * np.pi * time / period) * (1.0 + 0.2 * np.sin(time / 3.0)) + 0.1 * np.sin(
            2 * np.pi * time / 7.0
        )

    gyro = SampledSignal(t - offset, turned(t) + rng.normal(0.0, 0.002, len(t)))
    found = lead_of_motion(gyro, SampledSignal(t[::2], turned(t[::2]) + rng.normal(0.0, 0.002, len(t[::2]))))
    assert found is not None and found.seconds == pytest.approx(offset, abs=0.005)


def test_a_motion_without_information_has_no_lead() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    rng = np.random.default_rng(3)
    steady, noise = SampledSignal(t, 0.3 * t), SampledSignal.of_rates(t, rng.normal(0.0, 0.05, len(t)))
    assert lead_of_motion(noise, steady) is None and lead_of_motion(noise, SampledSignal(t, heading(t))) is None


@pytest.mark.parametrize("offset", [-0.6, 0.0, 0.4, 0.7])
def test_an_even_speed_after_the_start_has_no_wrong_lead(offset: float) -> None:
    """Without the start nearly any offset explains as much."""
    t, rng = np.arange(0.0, 12.0, 0.02), np.random.default_rng(4)
    speed = np.clip(0.8 * (t - 0.3), 0.0, 0.4)
    truth = SampledSignal(t, np.cumsum(speed) * 0.02 + rng.normal(0.0, 2e-4, len(t)))
    wheel = SampledSignal.of_rates(
        t - offset, 0.97 * speed * (1.0 + 0.02 * np.sin(0.4 * t)) + rng.normal(0.0, 2e-3, len(t))
    )
    found = lead_of_motion(wheel, truth)
    assert found is None or abs(found.seconds - offset) < 4.0 * found.error


@pytest.fixture(scope="module")
def drive() -> Recording:
    """Ten seconds of a car that turns both ways and stops."""
    legs = [(0.5, 0.0, 0.0), (2.0, 0.26, 0.25), (2.0, 0.15, -0.3), (0.5, 0.0, 0.0), (2.5, 0.26, -0.15), (3.0, 0.2, 0.2)]
    segments = [{"duration": d, "linear": [v, 0.0, 0.0], "angular": [0.0, 0.0, w]} for d, v, w in legs]
    overrides = {
        "camera.distortion": bags.DISTORTION,
        "rates.odometry": 60.0,
        "observer.P0": (0.1, 0.1),
        "vehicles.0.initial_estimate": {"position": [0.2, 0.0, 0.1], "yaw": 1.8},
        "horizon": 10.0,
        "vehicles.0.motion": {"kind": "segments", "segments": segments},
    }
    return record(load_scenario("crossing_path", overrides), 0)


BLOCKS, TWIST, TRUTH = "/agent8/pixy_node/objectsInfo", "/agent8/actuation_twist", "/qualisys/svea3/pose"


def opened(folder: Path, messages: list[bags.Message], text: str = bags.MAP) -> tuple[Bag, str]:
    """Return a bag, which is written once into a folder, and its notes."""
    (folder / "topics.toml").write_text(text, encoding="utf-8")
    path = folder / "bag"
    path = path if path.exists() else bags.write(path, messages, "mcap")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        bag = Bag([path], folder / "topics.toml")
    return bag, "\n".join(bag.log.notes)


def error_of(bag: Bag) -> float:
    """Return the position RMSE of the observer `robust`, m."""
    return float(run("robust", record(bag)).position_rmse(3.0)[0])


@pytest.fixture(scope="module")
def clean(drive: Recording) -> list[bags.Message]:
    return bags.messages(drive)


@pytest.fixture(scope="module")
def reference(clean: list[bags.Message], tmp_path_factory: pytest.TempPathFactory) -> float:
    """The error on the clean bag, m."""
    return error_of(opened(tmp_path_factory.mktemp("clean"), clean)[0])


@pytest.mark.parametrize(
    ("topic", "offset", "at_reception"),
    rest_slow([(TWIST, -0.45, False), (BLOCKS, 0.3, True), (TRUTH, 0.15, True), ("", 0.0, False)], 0, 2),
)
def test_a_topic_with_another_clock_and_wrong_stamps_cost_nothing(
    topic: str, offset: float, at_reception: bool, clean: list[bags.Message], reference: float, tmp_path: Path
) -> None:
    moved = bags.later(clean, stamps=offset, received=offset if at_reception else 0.0, topics=topic or "/none")
    frames = [m for m in moved if m.topic == BLOCKS]
    wrong = frames[40::97]
    assert len(wrong) > 5
    bag, notes = opened(tmp_path, [*(m for m in moved if m not in wrong), *bags.later(wrong, stamps=3.0)])
    assert error_of(bag) < 1.3 * reference + 5e-4
    rows = {row.topic: row for row in bag.log.rows}
    assert rows[BLOCKS].outlying == len(wrong) and f"{len(wrong)} of {len(frames)} messages left out: wrong" in notes
    if topic in (TWIST, BLOCKS):
        assert rows[topic].lead == pytest.approx(-offset, abs=0.02)  # twists are held until the next one
        assert re.search(rf"svea3: .* truth by \d+\(\d+\) ms; stamps were moved .* \"{topic}\" = ", notes)
    assert ("stamps were moved" in notes) == bool(topic) and ('{ "truth" = -0.1' in notes) == (topic == TRUTH)


CAMERAS: Any = (("distortion", [0.0] * 5), ("position", [0.39, 0.03, 0.2233]), ("focal_length", [220.0, 220.0]))


@pytest.mark.parametrize(
    ("key", "wrong", "offset"), rest_slow(((*camera, at) for camera in CAMERAS for at in (0.0, -0.13)), 0, 3, 5)
)
def test_a_wrong_camera_is_no_offset(
    key: str, wrong: list[float], offset: float, clean: list[bags.Message], tmp_path: Path
) -> None:
    (tmp_path / "topics.toml").write_text(bags.MAP, encoding="utf-8")
    path = bags.write(tmp_path / "bag", bags.later(clean, stamps=offset, topics=BLOCKS), "mcap")
    with warnings.catch_warnings(action="ignore"):
        bag = Bag([path], tmp_path / "topics.toml", {f"camera.{key}": wrong})
    assert {row.topic: row.lead for row in bag.log.rows}[BLOCKS] == pytest.approx(-offset, abs=0.003)
    assert ("moved" in "".join(bag.log.notes)) == bool(offset)


@pytest.mark.parametrize("jump", rest_slow([0.4, -2.5], 1))
def test_a_clock_that_jumps_costs_nothing(
    jump: float, clean: list[bags.Message], reference: float, tmp_path: Path
) -> None:
    late = [m.received > 5 * S and m.topic in (BLOCKS, TWIST) for m in clean]
    moved = [bags.later([m], stamps=jump * off)[0] for m, off in zip(clean, late, strict=True)]
    bag, notes = opened(tmp_path, moved)
    assert error_of(bag) < 1.3 * reference + 5e-4
    assert f"{BLOCKS}: its clock jumps by {jump:+.3f} s, which was removed" in notes
    assert all(row.outlying == 0 for row in bag.log.rows if row.topic == BLOCKS)
    unchanged, silent = opened(tmp_path, moved, f'{bags.MAP}[clocks]\nmode = "stamps"\n')
    assert error_of(unchanged) > 10.0 * reference and "removed" not in silent


def test_the_printed_offsets_give_the_same_result_in_the_map(clean: list[bags.Message], tmp_path: Path) -> None:
    apart = bags.later(clean, stamps=-0.3, topics=TWIST)
    bag, notes = opened(tmp_path, apart)
    key = re.search(r"clocks\.(offsets = \{.*\})", notes)
    assert key is not None
    stated, silent = opened(tmp_path, apart, f"{bags.MAP}[clocks]\n{key[1]}\n")
    assert "moved" not in silent
    first, second = ([s.stamp for s in each.log.samples] for each in (bag, stated))
    assert np.abs(np.subtract(first, second)).max() < 100_000
    _, unchanged = opened(tmp_path, apart, f'{bags.MAP}[clocks]\nmode = "stamps"\n')
    assert "stamps are unchanged" in unchanged
    with pytest.raises(
        DataError, match=r"topics.toml: clocks.offsets: /agent8/twist is none of the topics .*actuation"
    ):
        opened(tmp_path, apart, f'{bags.MAP}[clocks]\noffsets = {{ "/agent8/twist" = 0.3 }}\n')


def test_without_motion_capture_the_camera_is_the_reference(clean: list[bags.Message], tmp_path: Path) -> None:
    without = [m for m in clean if m.topic != TRUTH]
    bag, notes = opened(tmp_path, bags.later(without, stamps=-0.45, topics=TWIST))
    lead = {row.topic: row.lead for row in bag.log.rows}[TWIST]
    assert lead == pytest.approx(0.45, abs=0.03) and "wheel leads the camera of svea3 by 4" in notes
