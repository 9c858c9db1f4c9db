"""What a run on cars reports: of the vehicles that are estimated there alone, and in the words of real time."""

from __future__ import annotations

import io
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from coopenv.base.errors import CoopenvError, DataWarning
from coopenv.cars.backend.backend import open_svea
from coopenv.cars.backend.station import Gates
from coopenv.cars.codec import encode, header, make
from coopenv.cars.profile import SVEA, USUAL, Role
from coopenv.runs.command import execute, report
from coopenv.runs.demo import links_line, links_report
from coopenv.runs.rollouts import Rollout
from coopenv.viz.trajectories import trajectory_figure_2d
from tests.helpers.cars import OVERTAKING, cars, fakes, write_fleet
from tests.helpers.hub import Hub

NEAR = {"vehicles.vehicle_1.goal.radius": 3.7, "horizon": 9.0}
"""The first vehicle arrives after some two seconds, and the other one never."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """A run of one car alone, and what it has printed."""
    folder, log, out = tmp_path_factory.mktemp("run"), io.StringIO(), io.StringIO()
    path = write_fleet(folder)
    with fakes(path) as (hub, _):
        backend = cars(path, hub, car="svea7", overrides=NEAR)
        try:
            made = Rollout(backend.scenario, 0, policy="route_follower", backend=backend, options={"arm": True})
            told = lambda: links_line(backend)  # noqa: E731
            result = execute("lab", made, folder / "out", Console(file=log), NEAR, 1.0, "png", False, told)
            report(made, result, folder / "out", Console(file=out, width=100))
            links_report(backend, Console(file=out, width=100))
        finally:
            backend.close()
    return {"run": made, "result": result, "out": out.getvalue(), "log": log.getvalue(), "folder": folder / "out"}


def test_it_ends_with_the_vehicles_that_are_estimated_here(run: dict[str, Any]) -> None:
    made = run["run"]
    assert made.vehicles == (0,)
    assert [ending.outcome for ending in made.endings()] == ["arrived"]
    assert 30 < made.ticks_recorded < 400  # of 540
    assert "all vehicles estimated here had ended" in run["result"]["outcome"]


def test_no_table_is_about_a_vehicle_that_is_estimated_elsewhere(run: dict[str, Any]) -> None:
    assert [row["vehicle"] for row in run["result"]["vehicles"]] == ["vehicle_1"]
    about = [line for line in run["out"].splitlines() if "vehicle_2" in line]
    assert about == ["vehicle_2: received by radio, not estimated here"]
    assert (run["folder"] / "errors.png").stat().st_size > 10_000


def test_figures_name_a_vehicle_that_is_estimated_elsewhere(run: dict[str, Any]) -> None:
    made = run["run"]
    figure = trajectory_figure_2d(made.trajectory().of_vehicles([0]), scenario=made.scenario)
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words.count("received by radio") == 1 and "moving landmark" not in words and "$f_{2}$" not in words
    assert "$f_{2}$" in [text.get_text() for text in figure.axes[0].texts]


def test_its_words_are_those_of_real_time(run: dict[str, Any]) -> None:
    assert "in real time, seed 0" in run["out"] and "s of real time." in run["out"]
    assert "imulated" not in run["out"] and "noise" not in run["out"]
    first = run["log"].splitlines()[:1]
    assert not first or "about 9 s left" in first[0]


def test_the_record_of_some_vehicles_keeps_the_others_as_targets(run: dict[str, Any]) -> None:
    whole = run["run"].trajectory()
    second = whole.of_vehicles([1])
    assert second.vehicles.tolist() == ["vehicle_2"] and second.targets.tolist() == whole.targets.tolist()
    np.testing.assert_array_equal(second.position[:, 0], whole.position[:, 1])
    np.testing.assert_array_equal(second.visible[:, 0], whole.visible[:, 1])
    np.testing.assert_array_equal(second.t, whole.t)
    assert whole.of_vehicles([0, 1]) is whole


def test_what_gates_refused_before_does_not_count() -> None:
    hub = Hub()
    link, gate = hub.connect(), hub.connect()
    gates = Gates(link, ("svea7",), USUAL, None)

    def say(state: str, session: str, stale: int) -> None:
        counts = {"rejections": ["stale", "session"], "counts": np.array([stale, 3], dtype=np.uint64)}
        about: dict[str, Any] = {"header": header(time.time_ns()), "session": session, "nonce": "n", "state": state}
        message = make(SVEA.topics[Role.GATE].type, **about, **counts, accepted=0, last_sequence=0)
        gate.publish(SVEA.topic_of("svea7", Role.GATE), encode(message))

    assert gates.refused("svea7") == {}
    say("disarmed", "", 40)
    assert sum(gates.refused("svea7").values()) == 0
    gate.subscribe(SVEA.topic_of("svea7", Role.ARM), lambda _: say("armed", gates.session, 42))
    say("disarmed", "", 41)
    assert gates.refused("svea7") == {"stale": 1, "session": 0}
    gates.begin()
    assert sum(gates.refused("svea7").values()) == 0
    say("armed", gates.session, 47)
    assert gates.refused("svea7") == {"stale": 5, "session": 0}
    assert gates.states["svea7"].rejections == {"stale": 47, "session": 3}  # what it says itself
    say("armed", gates.session, 2)
    assert gates.refused("svea7") == {"stale": 2, "session": 3}  # it was started anew


def test_what_no_camera_can_tell_is_told(tmp_path: Path) -> None:
    path = write_fleet(tmp_path, OVERTAKING.replace("SL2 = 2, ", "").replace("marker = 6", ""))
    with pytest.warns(DataWarning, match=r"fleet\.toml: no markers, .*: SL2, vehicle_2$"):
        cars(path, Hub()).close()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cars(write_fleet(tmp_path), Hub()).close()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (('"svea_overtaking"', '"gone.toml"'), r"^fleet\.toml: environment: no such scenario file: .*gone\.toml$"),
        (('"svea_overtaking"', '"svea_overtakin"'), r"^fleet\.toml: environment: unknown environment .*did you mean"),
        (("fakes", 'overrides = { "noise.velosity" = 1 }\nfakes'), r"^fleet\.toml: overrides: noise\.velosity: unkn"),
        (("fakes", 'overrides = { "vehicles.9.yaw" = 1 }\nfakes'), r"^fleet\.toml: override 'vehicles\.9\.yaw'"),
        (("fakes", 'security.keys = "nokeys"\nfakes'), r"^fleet\.toml: security\.keys: there is no folder '.*nokeys'"),
    ],
)
def test_mistakes_in_a_deployment_name_file_and_field(change: tuple[str, str], line: str, tmp_path: Path) -> None:
    path = write_fleet(tmp_path, OVERTAKING.replace(*change))
    with pytest.raises(CoopenvError, match=line):
        cars(path, Hub())


def test_a_mistake_of_the_command_line_is_not_the_files(tmp_path: Path) -> None:
    path = write_fleet(tmp_path, 'overrides = { "noise.velocity" = 0.1 }\n' + OVERTAKING)
    with pytest.raises(CoopenvError, match=r"^overrides \(--set\): noise\.velosity: unknown key"):
        open_svea(path, None, {"noise.velosity": 1}, transport=Hub().connect())
    with pytest.raises(CoopenvError, match=r"^unknown environment 'gone'"):
        open_svea(path, "gone", transport=Hub().connect())
