"""What one car tells of itself and another one hears: the same place, wherever the map has its origin."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from coopenv.backends.base import VehicleBroadcast
from coopenv.cars.backend.assembler import Assembler
from coopenv.cars.backend.binding import estimate_message, report_message
from coopenv.cars.codec import decode, encode
from coopenv.cars.profile import SVEA, Role
from coopenv.cars.readings import Sample, read
from coopenv.estimation.poses import exp_so3
from coopenv.observers.contract import Message
from tests.cars.backend.test_assembler import MS, START, binding

ORIGIN = np.array([1.0, 2.0, 0.0])
PLACE, ROTATION = np.array([0.7, -0.4, 0.1]), exp_so3(np.array([0.0, 0.0, 0.8]))
ODOMETRY = np.array([0.0, 0.0, 0.3, 0.5, 0.2, 0.0])


def told() -> VehicleBroadcast:
    extra = {"odometry": ODOMETRY, "depends_on": np.array([2], dtype=np.uint64)}
    covariance = np.diag([1e-3, 1e-3, 2e-3, 0.01, 0.02, 0.03])
    return VehicleBroadcast(0, ROTATION, PLACE, covariance, Message(PLACE, ROTATION, covariance, extra))


@pytest.mark.parametrize(("role", "write"), [(Role.ESTIMATE, estimate_message), (Role.REPORT, report_message)])
def test_what_one_says_is_where_the_other_hears_it(role: Role, write: Any) -> None:
    message = decode(encode(write(told(), START, ORIGIN)), SVEA.topics[role].type)
    place = getattr(message.pose, "pose", message.pose).position
    np.testing.assert_allclose([place.x, place.y, place.z], PLACE + ORIGIN)  # as in the laboratory's coordinates
    assembler = Assembler(binding(2, only="car1", map={"origin": ORIGIN.tolist()}))
    assembler.begin(START - MS)
    assembler.put(Sample("car0", role, START, START + MS, read(role, message)))
    heard = assembler.tick(1, START + 2 * MS).messages[1, 0].message
    marker = np.array([0.1, 0.0, 0.2]) if role is Role.ESTIMATE else np.zeros(3)  # a report is of the marker already
    np.testing.assert_allclose(np.asarray(heard.position), PLACE + ROTATION @ marker, atol=1e-12)
    np.testing.assert_allclose(np.asarray(heard.rotation), ROTATION, atol=1e-12)
    if role is Role.REPORT:
        np.testing.assert_allclose(heard.extra["odometry"], ODOMETRY, atol=1e-12)  # from where it began
