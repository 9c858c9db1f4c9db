"""From messages to samples: what of a message counts, by where odometry is to come from."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from coopenv.cars.backend.assembler import Assembler, Intake
from coopenv.cars.codec import encode, header, make
from coopenv.cars.deployment import Sensors
from coopenv.cars.profile import SVEA, Role
from coopenv.cars.transport.base import Arrival
from tests.cars.backend.test_hostile import binding

MS = 1_000_000
START = 10**12


@pytest.mark.parametrize(
    ("odometry", "turned"),
    [("wheel+imu", 1.0), ("wheel", 0.6)],  # rad: 2 s of the gyro's 0.5 rad/s, or of the wheels' 0.3
)
def test_the_wheels_turn_rate_counts_only_without_a_gyro(odometry: Any, turned: float) -> None:
    bound = binding()
    intake, assembler = Intake(bound, Sensors(odometry=odometry)), Assembler(bound)
    assembler.begin(START)
    heading = 0.0
    for k in range(2001):
        now, spoken = START + k * MS, dict[Role, dict[str, Any]]()
        if k % 10 == 0:
            spoken[Role.IMU] = {"angular_velocity": (0.0, 0.0, 0.5)}
        if k % 20 == 3:
            spoken[Role.WHEEL] = {"twist": {"twist": ((0.2, 0.0, 0.0), (0.0, 0.0, 0.3))}}
        for role, fields in spoken.items():
            payload = encode(make(SVEA.topics[role].type, header=header(now), **fields))
            for sample in intake.samples(Arrival(SVEA.topic_of("svea7", role), payload, now)):
                assembler.put(sample)
        if k % 50 == 0 and k > 0:
            R = assembler.tick(k // 50, now).rotation[0]
            heading += float(np.arctan2(R[1, 0], R[0, 0]))
    assert heading == pytest.approx(turned, abs=0.015)
