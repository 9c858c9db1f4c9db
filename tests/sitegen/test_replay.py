"""The file that the home page replays, against a run."""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest

from sitegen import replay


def test_the_home_page_replays_what_a_run_gives() -> None:
    text = replay.FILE.read_text(encoding="utf-8")
    assert len(text) < 3e6
    data = json.loads(text.removeprefix("window.coopenvReplay="))
    assert len(data["variants"]) == len(replay.OBSERVERS) * len(replay.BROKEN)
    record = replay.record_of("riccati", 0, 2.0)
    count, n = len(record), len(data["colours"])

    def numbers(text: str, width: int) -> np.ndarray:
        whole = np.frombuffer(base64.b64decode(text), "<i2").astype(float)
        return (whole * data["step"]).reshape(data["frames"], n, width)[:count]

    truth, estimate = numbers(data["truth"], 3), numbers(data["variants"]["riccati/0"]["estimate"], 6)
    assert data["frames"] / data["rate"] == pytest.approx(replay.LENGTH, abs=0.2)
    np.testing.assert_allclose(truth[..., :2], record["target_position"][:, -n:, :2], atol=0.03)
    np.testing.assert_allclose(estimate[..., :2], record["position_estimate"][..., :2], atol=0.1)
    R = record["rotation_estimate"]  # no vehicle is drawn otherwise than it stands
    np.testing.assert_allclose(np.cos(estimate[..., 2]), R[..., 0, 0] / np.hypot(R[..., 0, 0], R[..., 1, 0]), atol=0.05)
    lost = numbers(data["variants"]["riccati/0"]["lost"], 1)[..., 0] > 0
    length = 0.042 * data["side"]  # of a vehicle without a body
    clear = np.abs(record["position_error"] - length) > 0.1
    np.testing.assert_array_equal(lost[clear], (record["position_error"] > length)[clear])
