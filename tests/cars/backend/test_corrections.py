"""A calibration file corrects what a live car measures: fakes with one wrong constant each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coopenv.cars.backend.assembler import Intake
from coopenv.cars.backend.buffers import StatusBoard
from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.fake.settings import FakeSettings
from coopenv.cars.messages.readings import Detections, Twist
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.deployment import Deployment, DeploymentError, Remote, load_deployment
from coopenv.cars.settings.profile import SVEA, Role
from tests.helpers.cars import LAB, LAB_CARS
from tests.helpers.fakes import EXACT, OVERTAKING, Stage

pytest.importorskip("rosbags", reason="needs the extra 'svea'")

CAMERA = "/fleet/svea7/pixy/objects_info"
CALIBRATION = """
[overrides]
"vehicles.0.camera.position" = [0.3, 0.0, 0.2]

[clocks.leads]
"{topic}" = {lead}

[corrections.{car}]
"focal_length" = [230.0, 231.0]
"wheel_scale" = 0.1
"gyro_bias" = 0.2

[constants]
"svea7.gyro.bias" = {{ given = 0, value = 0.2, standard_error = 0.001, unit = "{unit}", finding = "wrong" }}
"""


def fleet(folder: Path, **changes: Any) -> Deployment:
    """Return a deployment with a calibration."""
    text = CALIBRATION.format(**{"topic": CAMERA, "lead": 0.3, "car": "svea7", "unit": "rad/s"} | changes)
    (folder / "calibration.toml").write_text(text, encoding="utf-8")
    path = folder / "fleet.toml"
    path.write_text(f'calibration = "calibration.toml"\n{LAB}{LAB_CARS}', encoding="utf-8")
    return load_deployment(path)


def test_the_key_brings_overrides_corrections_and_leads(tmp_path: Path) -> None:
    made = fleet(tmp_path)
    assert made.overrides == {"vehicles.0.camera.position": [0.3, 0.0, 0.2]}
    assert made.sensors.leads == {CAMERA: 0.3} and made.sensors.corrections["svea7"].gyro_bias == 0.2
    assert "leads" in made.model_dump()["sensors"]  # a record of a drive is replayed with them


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"unit": "deg/s"}, r"calibration: calibration\.toml: constants\.unit: .*'rad/s'.*got 'deg/s'"),
        ({"lead": 300.0}, r"fleet\.toml: sensors\.leads: .*equal to 2, got 300"),  # in ms
        ({"topic": "/fleet/svea7/pixy/objects"}, r"sensors\.leads: unknown '/fleet/svea7/pixy/objects'.*objects_info"),
        ({"car": "svea8"}, r"sensors\.corrections: unknown 'svea8'.*svea7"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused(changes: dict[str, Any], line: str, tmp_path: Path) -> None:
    with pytest.raises(DeploymentError, match=line) as caught:
        fleet(tmp_path, **changes)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def stage() -> Stage:
    """Fakes whose wheels, gyro and lens have other constants than the environment."""
    fakes = {"camera.focal_length": [230.0, 231.0], "camera.quantise": False}
    wrong = FakeSettings(wheel_scale=0.1, gyro_bias=0.2)
    made = Stage("svea_overtaking", OVERTAKING, EXACT | fakes, settings=wrong)
    made.drive("svea7", 0.3, 0.2, 3.0)
    return made


def read(stage: Stage, sensors: Any) -> dict[Role, list[Any]]:
    """Return by role the samples that a station with the environment's constants reads of the fakes."""
    usual = Stage("svea_overtaking", OVERTAKING, EXACT).binding
    intake = Intake(usual, sensors)
    found: dict[Role, list[Any]] = {}
    for arrival in stage.hub_arrivals:
        for sample in intake.samples(arrival):
            if sample.car == "svea7":
                found.setdefault(sample.role, []).append(sample)
    return found


def last(samples: list[Any]) -> Twist:
    value = samples[-1].value
    assert isinstance(value, Twist)
    return value


def test_wheels_gyro_lens_and_stamps_are_corrected(stage: Stage, tmp_path: Path) -> None:
    sensors = fleet(tmp_path).sensors
    plain, right = read(stage, sensors.model_copy(update={"corrections": {}, "leads": {}})), read(stage, sensors)
    before, after = (last(found[Role.WHEEL]).linear for found in (plain, right))
    assert before is not None and after is not None
    assert before[0] == pytest.approx(0.33, abs=0.005) and after[0] == pytest.approx(0.3, abs=0.005)
    rates = [last(found[Role.IMU]).angular for found in (plain, right)]
    assert rates[0] is not None and rates[1] is not None
    np.testing.assert_allclose(rates[0] - rates[1], [0.0, 0.0, 0.2])
    assert rates[1][2] == pytest.approx(stage.cars["svea7"].world.twist[1][2], abs=0.01)
    frames = [[s for s in found[Role.DETECTIONS] if len(s.value.markers)] for found in (plain, right)]
    assert len(frames[0]) == len(frames[1]) > 20
    for a, b in zip(*frames, strict=True):
        assert b.stamp - a.stamp == 300_000_000 and isinstance(a.value, Detections)
    own = Intake(stage.binding, sensors.model_copy(update={"corrections": {}}))
    exact = {s.stamp: s.value for arrival in stage.hub_arrivals for s in own.samples(arrival) if s.car == "svea7"}
    for a, b in zip(*frames, strict=True):
        np.testing.assert_allclose(b.value.bearings, exact[b.stamp].bearings, atol=1e-12)
        assert not np.allclose(a.value.bearings, b.value.bearings, atol=1e-3)


def test_a_corrected_lens_takes_the_place_of_what_the_camera_publishes(tmp_path: Path) -> None:
    made = fleet(tmp_path)
    binding = Stage("svea_overtaking", OVERTAKING, EXACT).binding
    board = StatusBoard(Hub().connect(), ("svea7",), Remote(), False, SVEA)
    published = board.calibrations["svea7"] = Calibration.of(binding.scenario.cameras[0])
    right = made.sensors.corrections["svea7"]
    used = Intake(binding, made.sensors).calibrations["svea7"]
    assert used == replace(published, focal_length=(230.0, 231.0))
    assert not list(board.obstacles("svea7", 0.0, used, right))
    [line] = board.obstacles("svea7", 0.0, used)
    assert "its camera publishes focal_length" in line
