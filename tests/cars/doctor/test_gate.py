"""Bags with faults: commands name the cause, a mended drive is the sound one, a refused one runs if it is trusted."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import coopenv
from coopenv.base.errors import CoopenvError, DataError, DataWarning
from coopenv.cars.bags.bag import Bag
from coopenv.cars.bags.topic_map import load_map
from coopenv.cars.doctor.finding import Treatment
from coopenv.cars.messages.readings import Twist
from coopenv.cli.app import main
from coopenv.observers import Recording
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from coopenv.sources.selection import Selection
from tests.helpers import bags

pytest.importorskip("rosbags", reason="needs the extra 'log'")
TWIST, BLOCKS = "/agent8/actuation_twist", "/agent8/pixy_node/objectsInfo"


@pytest.fixture(scope="module")
def drive() -> Recording:
    """Ten seconds in which the car turns to both sides."""
    turns = [(1.5, 0.26, 0.3), (2.0, 0.26, -0.5), (2.0, 0.15, 0.4), (2.5, 0.26, -0.3), (1.5, 0.2, 0.5)]
    segments = [{"duration": t, "linear": [v, 0.0, 0.0], "angular": [0.0, 0.0, w]} for t, v, w in turns]
    overrides = {
        "camera.distortion": bags.DISTORTION,
        "rates.odometry": 60.0,
        "horizon": 9.5,
        "observer.P0": (0.1, 0.1),
        "vehicles.0.initial_estimate": {"position": [0.2, 0.0, 0.1], "yaw": 1.8},
        "vehicles.0.motion": {"kind": "segments", "segments": segments},
    }
    return record(load_scenario("crossing_path", overrides), 0)


def changed(drive: Recording, topic: str, change: Callable[[bags.Message], bags.Message]) -> list[bags.Message]:
    return [change(m) if m.topic == topic else m for m in bags.messages(drive)]


def turning(factor: float) -> Callable[[bags.Message], bags.Message]:
    def change(m: bags.Message) -> bags.Message:
        linear, angular = m.fields["twist"]["twist"]
        return replace(
            m, fields={"twist": {"twist": (linear, factor * np.asarray(angular)), "covariance": np.zeros(36)}}
        )

    return change


def opened(folder: Path, messages: list[bags.Message], trust: tuple[str, ...] = ()) -> Bag:
    folder.mkdir(exist_ok=True)
    (folder / "topics.toml").write_text(bags.MAP, encoding="utf-8")
    path = folder / "bag"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return Bag([path if path.exists() else bags.write(path, messages, "mcap")], folder / "topics.toml", trust=trust)


def rates(bag: Bag) -> np.ndarray:
    return np.array([s.value.angular for s in bag.log.samples if isinstance(s.value, Twist)])


@pytest.fixture(scope="module")
def sound(drive: Recording, tmp_path_factory: pytest.TempPathFactory) -> Bag:
    return opened(tmp_path_factory.mktemp("sound"), bags.messages(drive))


def test_turn_rates_in_degrees_are_mended_and_a_sound_bag_is_silent(
    drive: Recording, sound: Bag, tmp_path: Path
) -> None:
    assert not sound.log.findings
    bag = opened(tmp_path, changed(drive, TWIST, turning(57.29578)))
    [found] = bag.log.findings
    assert found.subject == TWIST and found.treatment is Treatment.MENDED and "deg/s" in found.text
    np.testing.assert_allclose(rates(bag), rates(sound), rtol=1e-5)
    text = bags.MAP + f"[corrections.svea3]\ngyro_factor = {found.key.rpartition(' ')[2]}\n"
    (tmp_path / "own.toml").write_text(text, encoding="utf-8")
    stated = Bag([tmp_path / "bag"], tmp_path / "own.toml")
    assert not stated.log.findings
    np.testing.assert_allclose(rates(stated), rates(bag), rtol=1e-6)


def test_a_refused_drive_runs_if_the_topic_is_trusted_and_the_title_names_it(
    drive: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`calibrate` tries no constants here, so that it finds none."""
    bag = opened(tmp_path, changed(drive, TWIST, turning(0.0)))
    with pytest.raises(
        DataError, match=rf"{TWIST}: the turn rate .* is 0 rad/s .*; --trust '{TWIST}' uses it unchanged"
    ):
        next(iter(bag.episode(None, {})))
    path, given = str(tmp_path / "bag"), ["--map", str(tmp_path / "topics.toml")]
    short = ["--no-figures", "--steps", "2", "--out", str(tmp_path / "out"), "--observer", "dead_reckoning"]
    assert main(["run", path, *given, *short]) == 2
    assert "is 0 rad/s in all" in capsys.readouterr().err
    monkeypatch.setattr("coopenv.cars.calibration.calibrate.corrected", lambda batch, given: given)
    main(["calibrate", path, *given, "--out", str(tmp_path / "calibration")])
    printed = capsys.readouterr().out
    assert f"{TWIST}: the turn rate of svea3 is 0 rad/s" in printed and "No constant is wrong" not in printed
    assert main(["run", path, *given, *short, "--trust", TWIST]) == 0
    assert f"(trusted: {TWIST})" in capsys.readouterr().out
    stated = load_map(tmp_path / "topics.toml").model_copy(update={"trust": ("all",)})
    with pytest.warns(DataWarning, match="trusted"):
        assert next(iter(Bag([tmp_path / "bag"], stated).episode(None, {}))).index == 0


def test_the_command_lists_findings_as_a_table_and_as_json(
    drive: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    opened(tmp_path, changed(drive, TWIST, turning(0.0)))
    line = ["doctor", str(tmp_path / "bag"), "--map", str(tmp_path / "topics.toml")]
    assert main(line) == 1
    assert "is 0 rad/s in all" in " ".join(capsys.readouterr().out.split())
    assert main([*line, "--json", "--trust", TWIST]) == 0
    [found] = json.loads(capsys.readouterr().out)["findings"]
    assert found["subject"] == TWIST and found["treatment"] == "trusted"


def test_a_simulation_at_half_speed_gives_the_ticks_of_the_drive(drive: Recording, sound: Bag, tmp_path: Path) -> None:
    slow = [replace(m, received=2 * m.received) for m in bags.messages(drive)]
    bag = opened(tmp_path, slow)
    [found] = bag.log.findings
    assert found.subject == "clocks" and "0.5 times as fast" in found.text
    assert bag.capabilities.ticks == sound.capabilities.ticks


def test_trust_is_for_bags() -> None:
    with pytest.raises(CoopenvError, match="trust"):
        coopenv.run("crossing_path", trust=["/imu"])
    assert Selection(trust=("/imu", "clocks")).remark == " (trusted: /imu, clocks)"


def test_only_streams_can_be_trusted(drive: Recording, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="trust: unknown stream '/imv'"):
        opened(tmp_path, bags.messages(drive), trust=("/imv",))
    bag = opened(tmp_path, [], trust=("markers", TWIST))
    assert "trusted" not in bag.scenario.title
