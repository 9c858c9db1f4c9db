"""Faults: how they are asked for, and what they do to what a car says and obeys."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.base.fault_text import FaultError
from coopenv.cars.fake import car
from coopenv.cars.fake.settings import FAKE_FAULTS, CarFaults, fake_fault, fault_topic
from coopenv.cars.messages.codec import stamp_of
from coopenv.cars.settings.profile import SVEA, Role
from tests.helpers.fakes import CROSSING, EXACT, OVERTAKING, Stage


@given(
    kind=st.sampled_from(["loss", "delay", "duplicate_blocks"]),
    value=st.floats(0, 1),
    start=st.floats(0, 1e5),
    duration=st.floats(0, 1e5) | st.none(),
)
def test_a_written_fault_is_read(kind: str, value: float, start: float, duration: float | None) -> None:
    text = f"{kind}={value!r}@{start!r}" + ("" if duration is None else f"+{duration!r}")
    found = fake_fault(text)
    begun = (found.name, found.value, found.start_in(0.0), found.duration)
    assert begun == (kind, value, start, float("inf") if duration is None else duration)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("loose=0.1", r"unknown fault 'loose' \(did you mean 'loss'\?\); known: .*swapped_signatures"),
        ("loss", r"fault loss: needs a value, loss=NUMBER"),
        ("loss=1.5", r"fault loss: value: expected a number from 0 to 1, got '1.5'"),
        ("loss=nan", r"fault loss: value: expected a number"),
        ("freeze@x", r"fault freeze: start: expected a number.*'x'"),
        ("freeze@1+-2", r"fault freeze: duration: expected a number.*'-2'"),
        ("loss=0.1@40%", "start must be a number of seconds"),
        ("svea7:loss=0.1", "fault loss: has no vehicles"),
        ("=3", r"fault '=3': expected \[VEHICLE:\]NAME\[=VALUE\]\[@START"),
    ],
)
def test_an_invalid_fault_is_one_line(text: str, said: str) -> None:
    with pytest.raises(FaultError, match=said) as caught:
        fake_fault(text)
    assert "\n" not in str(caught.value)


def test_a_fault_begins_and_ends() -> None:
    faults = CarFaults()
    faults.add(fake_fault("delay=0.2@1+2"), 10**9)
    faults.add(fake_fault("delay=0.5@2+0.5"), 10**9)
    times = [1.9, 2.0, 2.9, 3.1, 3.6, 3.9, 4.1]
    assert [faults.value("delay", int(t * 1e9)) for t in times] == [0.0, 0.2, 0.2, 0.5, 0.2, 0.2, 0.0]


@pytest.fixture
def stage() -> Stage:
    made = Stage("svea_overtaking", OVERTAKING, EXACT)
    made.run(0.3)
    return made


def test_a_frozen_car_sends_nothing_and_comes_to_a_stand(stage: Stage) -> None:
    stage.drive("svea7", 0.3, 0.0, 2.0)
    stage.ask("freeze@0+2")
    stage.forget()
    stage.drive("svea7", 0.3, 0.0, 1.9)
    assert not stage.arrivals("svea7", Role.WHEEL) and not stage.arrivals("svea7", Role.DETECTIONS)
    speeds = [m.twist.twist.linear.x for m in stage.arrivals("svea7", Role.TRUTH)]
    assert speeds[20] > 0.29 and abs(speeds[-1]) < 1e-3  # motion capture goes on; the flight controller went neutral
    assert stage.arrivals("svea8", Role.WHEEL)
    stage.drive("svea7", 0.3, 0.0, 1.0)
    assert stage.arrivals("svea7", Role.WHEEL)[-1].twist.twist.linear.x > 0.25


def test_kill_ends_the_process(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    died: list[bool] = []
    monkeypatch.setattr(car, "end_process", lambda: died.append(True))
    stage.ask("kill@0.1")
    assert not died
    stage.run(0.15)
    assert died
    stage.forget()
    stage.run(0.1)
    assert stage.arrivals("svea8", Role.IMU) and not stage.arrivals("svea7", Role.IMU)


def test_loss_and_delay(stage: Stage) -> None:
    stage.forget()
    stage.ask("loss=0.3@0+2")
    stage.run(2.0)
    assert 0.55 < len(stage.arrivals("svea7", Role.IMU)) / 200 < 0.85
    assert len(stage.arrivals("svea8", Role.IMU)) > 195
    stage.ask("delay=0.25")
    stage.run(0.5)
    stage.forget()
    stage.run(0.5)
    stamps = [stamp_of(m) for m in stage.arrivals("svea7", Role.IMU)]
    assert len(stamps) > 45
    assert (stage.wall + stage.now - max(stamps)) * 1e-9 == pytest.approx(0.255, abs=0.012)


def test_the_cars_clock_is_wrong_and_that_of_motion_capture_is_not(stage: Stage) -> None:
    stage.ask("clock_offset=0.5")
    stage.ask("clock_drift=0.01")
    stage.run(2.0)
    stage.forget()
    stage.run(0.1)
    ahead = [stamp_of(m) - stage.wall - stage.now for m in stage.arrivals("svea7", Role.WHEEL)]
    assert ahead[-1] * 1e-9 == pytest.approx(0.521, abs=0.03)
    truth = [stamp_of(m) - stage.wall - stage.now for m in stage.arrivals("svea7", Role.TRUTH)]
    assert -0.02 < truth[-1] * 1e-9 <= 0.0


def frames(stage: Stage, seconds: float) -> list[list[tuple[int, int, int]]]:
    stage.forget()
    stage.run(seconds)
    found = stage.arrivals("svea8", Role.DETECTIONS)
    return [[(b.signature, b.center_x, b.center_y) for b in m.objects] for m in found]


def test_blocks_that_are_false_doubled_or_swapped(stage: Stage) -> None:
    before = frames(stage, 0.5)[-1]
    numbers = sorted(n for n, _, _ in before)
    assert set(numbers) == {1, 2, 4, 5}
    stage.ask("duplicate_blocks@0+1", "svea8")
    doubled = frames(stage, 0.9)[-1]
    assert sorted(n for n, _, _ in doubled) == sorted(numbers * 2)
    stage.run(0.2)
    stage.ask("swapped_signatures@0+1", "svea8")
    swapped = frames(stage, 0.9)[-1]
    assert sorted(n for n, _, _ in swapped) == numbers
    assert {(x, y) for _, x, y in swapped} == {(x, y) for _, x, y in before} and set(swapped) != set(before)
    stage.run(0.2)
    stage.ask("false_blocks=30@0+2", "svea8")
    extra = [len(frame) - len(before) for frame in frames(stage, 1.9)]
    assert sum(extra) == pytest.approx(30 * 1.9, rel=0.4)


def test_every_kind_can_be_asked_for_and_nonsense_is_reported(stage: Stage, capsys: pytest.CaptureFixture[str]) -> None:
    for name, kind in FAKE_FAULTS.items():
        stage.ask(f"{name}={kind.high:g}@1000")
    assert not capsys.readouterr().err
    stage.ask("melt")
    stage.network.publish(fault_topic("svea7"), b"\1\2")
    stage.network.publish(SVEA.topic_of("svea7", Role.MANUAL), b"nonsense")
    stage.run(0.01)
    error_lines = capsys.readouterr().err.splitlines()
    assert len(error_lines) == 3 and error_lines[0].startswith("svea7: unknown fault 'melt'")
    assert np.isfinite(stage.pose("svea7")[1]).all()


def test_a_flood_of_unreadable_messages_fills_neither_log_nor_memory(capsys: pytest.CaptureFixture[str]) -> None:
    stage = Stage("svea_crossing", CROSSING, EXACT)
    for _ in range(20):
        for _ in range(2 * car.MOST_WAITING):
            stage.network.publish(fault_topic("svea7"), b"nonsense")
        assert len(stage.cars["svea7"]._inbox) == car.MOST_WAITING
        stage.run(0.001)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == car.MOST_LINES and lines[-1].endswith("; further errors are not printed")
