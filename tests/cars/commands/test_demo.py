"""Runs on fake cars: `coopenv svea demo`, `svea run`, and what a run on cars reports."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from coopenv.base.errors import CoopenvError, DataWarning
from coopenv.cars.backend.backend import Svea, open_svea
from coopenv.cars.backend.station import Gates, Pacer
from coopenv.cars.commands.demo import FLEETS, Demo, links_line, links_report
from coopenv.cars.commands.svea import STOPPED
from coopenv.cars.fake.fleet import fakes as fake_processes
from coopenv.cars.fake.fleet import free_port
from coopenv.cars.fake.lockstep import Hub, LockstepFakes
from coopenv.cars.link.zenoh import open_zenoh
from coopenv.cars.messages.codec import encode, header, make
from coopenv.cars.settings.limits import USUAL
from coopenv.cars.settings.profile import SVEA, Role
from coopenv.cli.app import app
from coopenv.estimation.trajectory import Trajectory
from coopenv.runs.command import execute, report
from coopenv.runs.rollouts import Rollout
from coopenv.viz.trajectories import trajectory_figure_2d
from tests.helpers.cars import OVERTAKING, PATIENT, cars, fakes, send_fault, write_fleet
from tests.helpers.commands import refused
from tests.helpers.processes import COOPENV, DEADLOCK, ROOT, mentioning, start, wait_until
from tests.helpers.wire import free_endpoint

SHIPPED = ROOT / "examples" / "fleet" / "overtaking.toml"
RESULTS = {"metrics.json", "trajectory.npz", "errors.png", "trajectories_2d.png", "topology.png"}


def real_time_demo(folder: Path, port: int, *options: str) -> subprocess.Popen[str]:
    return start((*COOPENV, "svea", "demo", "--real-time", "--port", str(port), *options), folder)


def driven_demo(folder: Path, *options: str) -> str:
    """Return what a demo prints."""
    process = start((*COOPENV, "svea", "demo", *options), folder)
    printed, errors = process.communicate(timeout=4 * DEADLOCK)
    assert process.returncode == 0, errors
    return printed


@pytest.mark.slow
@pytest.mark.parametrize("environment", FLEETS)
def test_the_demo_drives_and_can_be_run_again(environment: str, tmp_path: Path) -> None:
    printed = driven_demo(tmp_path, "--environment", environment)
    assert "RMSE" in printed and "vehicle_1: arrived at" in printed and " s driven, 0 of " in printed
    assert "on a simulated clock, seed 0" in printed
    assert {path.name for path in (tmp_path / "out" / environment).iterdir()} > RESULTS
    driven = json.loads((tmp_path / "out" / environment / "metrics.json").read_text())
    (command,) = (line.split(": ")[1] for line in printed.splitlines() if line.startswith("The drive, bit for bit"))
    _, *arguments = command.split()
    again = start((*COOPENV, *arguments, "--no-figures", "--json", "--out", "again"), tmp_path)
    replayed = json.loads(again.communicate(timeout=DEADLOCK)[0])
    assert driven["vehicles"] == replayed["vehicles"]
    assert all(0.0 < vehicle["steady_position_rmse_m"] < 0.1 for vehicle in driven["vehicles"])


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["starting", "driving"])
def test_an_interrupt_ends_all_processes_and_keeps_the_drive(moment: str, tmp_path: Path) -> None:
    port = free_port()
    process = real_time_demo(tmp_path, port)
    try:
        wait_until(lambda: len(mentioning(f"127.0.0.1:{port}")) >= 2)
        if moment == "driving":
            drives = tmp_path / "out"
            wait_until(lambda: any(path.stat().st_size > 200_000 for path in drives.glob(".*/*.mcap")))
        os.kill(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=DEADLOCK)
    finally:
        process.kill()
    assert process.returncode == 130
    wait_until(lambda: not mentioning(f"127.0.0.1:{port}"))
    drive = "out/svea_overtaking.mcap"
    driven = moment == "driving"
    outcome = f"written: {drive}; the drive up to here: coopenv run {drive}" if driven else "nothing written"
    assert errors.splitlines()[-1] == f"interrupted; {outcome}"
    kept = [str(path.relative_to(tmp_path)) for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert kept == ([drive] if driven else [])
    for path in kept:
        again = start((*COOPENV, "run", path, "--no-figures"), tmp_path)
        printed, errors = again.communicate(timeout=DEADLOCK)
        assert "Stopped: Interrupted" in printed and "warning" not in errors


@pytest.fixture
def fleet_of_my_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], list[str]]:
    """Return the command of a demo whose deployment has further settings."""
    monkeypatch.chdir(tmp_path)

    def command(settings: str) -> list[str]:
        text = SHIPPED.read_text()
        Path("mine.toml").write_text(text.replace("[safety]\n", f"[safety]\n{settings}\n"))
        return ["svea", "demo", "--fleet", "mine.toml", "--set", "horizon=3"]

    return command


@pytest.mark.slow
def test_cars_that_are_stopped_end_the_demo_with_a_status_of_its_own(
    fleet_of_my_own: Callable[[str], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    decide, begun = Pacer.decide, list[int]()

    def late_from_the_second_second_on(pacer: Pacer) -> None:
        decide(pacer)
        begun.append(pacer.now())
        pacer.in_a_row = 1000 * (begun[-1] - begun[0] > 1e9)

    monkeypatch.setattr(Pacer, "decide", late_from_the_second_second_on)
    result = CliRunner().invoke(app, fleet_of_my_own(""))
    assert result.exit_code == STOPPED, (result.output, result.exception)
    assert result.output.count("Stopped: ") == 1


@pytest.mark.slow
def test_without_true_poses_the_drive_is_kept_and_the_topics_are_reported(
    fleet_of_my_own: Callable[[str], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Trajectory, "with_truth", lambda trajectory, vehicles: [])
    result = CliRunner().invoke(app, fleet_of_my_own(""))
    assert isinstance(result.exception, CoopenvError)
    message = str(result.exception)
    assert message.startswith("mine: without true poses") and "svea7" in message and "too late for the ticks" in message
    assert "No true poses, and so no errors" in result.output
    (line,) = (line for line in result.output.splitlines() if "s driven" in line)
    missed, _, decisions = line.split(" s driven, ")[1].split()[:3]
    assert 0 <= int(missed) <= int(decisions) == 60
    assert Path("out/mine.mcap").exists() and "The drive, bit for bit: coopenv run out/mine.mcap" in result.output


def test_other_environments_have_no_demo() -> None:
    with pytest.raises(CoopenvError, match=r"no fleet of fakes for 'svea_overtaken' .*did you mean 'svea_overtaking'"):
        _ = Demo("svea_overtaken", Path("out")).fleet
    assert CliRunner().invoke(app, ["svea", "demo", "--environment", "facade"]).exit_code != 0


ENOUGH = 200_000
"""Bytes of a record in which an episode has begun."""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    path = write_fleet(tmp_path_factory.mktemp("fleet"), safety=PATIENT)
    with fake_processes(path) as router:
        yield path, router


def interrupted(fleet: tuple[Path, str], folder: Path, number: signal.Signals) -> tuple[str, int]:
    """Drive and record, send a signal on the way, and return what it says then and its status."""
    path, router = fleet
    options = ("--arm", "--policy", "route_follower", "--record", "drive.mcap", "--out", "out")
    process = start((*COOPENV, "svea", "run", str(path), "--connect", router, *options), folder)
    try:
        drive = folder / "drive.mcap"
        wait_until(lambda: process.poll() is not None or (drive.exists() and drive.stat().st_size > ENOUGH))
        process.send_signal(number)
        _, errors = process.communicate(timeout=DEADLOCK)
    finally:
        process.kill()
    return errors, process.returncode


def replayed(folder: Path) -> tuple[str, str]:
    process = start((*COOPENV, "run", "drive.mcap", "--no-figures", "--out", "again"), folder)
    printed, errors = process.communicate(timeout=2 * DEADLOCK)
    assert process.returncode == 0, errors
    return printed, errors


@pytest.mark.slow
def test_the_drive_of_an_interrupted_run_is_reported_and_replayed(fleet: tuple[Path, str], tmp_path: Path) -> None:
    errors, status = interrupted(fleet, tmp_path, signal.SIGINT)
    assert status == 130
    assert errors.splitlines()[-1] == "interrupted; kept: drive.mcap, the drive up to here: coopenv run drive.mcap"
    assert [path.name for path in tmp_path.iterdir()] == ["drive.mcap"]
    printed, errors = replayed(tmp_path)
    assert "Stopped: Interrupted\n" in printed and "warning" not in errors
    assert json.loads((tmp_path / "again" / "metrics.json").read_text())["policy"] == "recorded"


@pytest.mark.slow
def test_a_station_that_is_killed_leaves_its_drive(fleet: tuple[Path, str], tmp_path: Path) -> None:
    _, status = interrupted(fleet, tmp_path, signal.SIGKILL)
    assert status == -9
    printed, errors = replayed(tmp_path)
    (warning,) = (line for line in errors.splitlines() if line.startswith("warning"))
    assert (
        "drive.mcap: cut off, the end of the MCAP file is missing: nothing after " in warning
        and "is replayed" in warning
    )
    assert "ended before its time" in printed and "RMSE" in printed


def test_a_fleet_has_an_environment() -> None:
    line = refused("svea", "demo", "--fleet", "mine.toml", "--environment", "svea_crossing")
    assert "--environment: mine.toml names one; give --environment or --fleet" in line


def test_cars_that_say_nothing_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    endpoint = free_endpoint()
    with closing(open_zenoh("router", listen=[endpoint])):
        command = ["svea", "run", str(SHIPPED), "--connect", endpoint, "--steps", "3", "--no-figures"]
        result = CliRunner().invoke(app, [*command, "--steady-from", "0"])
        assert not any(Path("out").glob("*/*"))  # earlier results stay
        too_short = CliRunner().invoke(app, command)
    assert isinstance(result.exception, CoopenvError)
    assert str(result.exception).startswith(f"nothing has come from svea7, svea1 by {endpoint}")
    assert str(too_short.exception).startswith("steady_from 2 is not within the run of ")


def test_a_car_that_freezes_ends_the_run_with_a_status_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made = LockstepFakes(write_fleet(tmp_path))

    def opened(_path: Path, environment: None, overrides: Any, car: None, record: Path, connect: None) -> Svea:
        return made.station(environment, overrides=overrides, car=car, record=record)

    monkeypatch.setattr("coopenv.cars.backend.backend.open_svea", opened)
    send_fault(made.hub, "svea1", "freeze@3")
    command = ["svea", "run", "fleet.toml", "--arm", "--policy", "route_follower", "--record", "drive.mcap"]
    result = CliRunner().invoke(app, [*command, "--no-figures"])
    assert result.exit_code == STOPPED, (result.output, result.exception)
    assert "Stopped: svea1: " in result.output and "ended before its time" in result.output
    again = CliRunner().invoke(app, ["run", "drive.mcap", "--no-figures", "--out", "again"])
    assert again.exit_code == 0 and "Stopped: svea1: " in again.output, (again.output, again.exception)


NEAR = {"vehicles.vehicle_1.goal.radius": 3.7, "horizon": 9.0}
"""The first vehicle arrives after some two seconds, and the other one never."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """A run of one car alone, and what it has printed."""
    folder, log, out = tmp_path_factory.mktemp("run"), io.StringIO(), io.StringIO()
    path = write_fleet(folder)
    with fakes(path) as (hub, _), pytest.MonkeyPatch.context() as patch:
        patch.setattr("coopenv.viz.figures.FIGURE_NAMES", ("errors",))
        backend = cars(path, hub, car="svea7", overrides=NEAR)
        try:
            made = Rollout(backend.scenario, 0, policy="route_follower", backend=backend, options={"arm": True})
            links = lambda: links_line(backend)  # noqa: E731
            result = execute("lab", made, folder / "out", Console(file=log), NEAR, 1.0, "png", False, links)
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
    assert "all vehicles estimated here had ended" in run["result"].metrics["outcome"]


def test_no_table_is_about_a_vehicle_that_is_estimated_elsewhere(run: dict[str, Any]) -> None:
    assert [row["vehicle"] for row in run["result"].metrics["vehicles"]] == ["vehicle_1"]
    about = [line for line in run["out"].splitlines() if "vehicle_2" in line]
    assert about == ["vehicle_2: received by radio, not estimated here"]
    assert (run["folder"] / "errors.png").stat().st_size > 10_000


def test_figures_name_a_vehicle_that_is_estimated_elsewhere(run: dict[str, Any]) -> None:
    made = run["run"]
    figure = trajectory_figure_2d(made.trajectory().of_vehicles([0]), scenario=made.scenario)
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words.count("received by radio") == 1 and "moving landmark" not in words and "$f_{2}$" not in words
    assert "$f_{2}$" in [text.get_text() for text in figure.axes[0].texts]


def test_the_report_names_the_clock(run: dict[str, Any]) -> None:
    words = " ".join(run["out"].split())
    assert "on a simulated clock, seed 0" in words and re.search(r"Driven at \S+ times real time\.", words)
    assert "Simulated at" not in words and "noise" not in words


def test_the_record_of_some_vehicles_keeps_the_others_as_targets(run: dict[str, Any]) -> None:
    whole = run["run"].trajectory()
    second = whole.of_vehicles([1])
    assert second.vehicles.tolist() == ["vehicle_2"] and second.targets.tolist() == whole.targets.tolist()
    np.testing.assert_array_equal(second.position[:, 0], whole.position[:, 1])
    np.testing.assert_array_equal(second.visible[:, 0], whole.visible[:, 1])
    np.testing.assert_array_equal(second.t, whole.t)
    assert whole.of_vehicles([0, 1]) is whole


def test_refusals_before_the_arming_do_not_count() -> None:
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


def test_cars_and_landmarks_without_markers_are_reported(tmp_path: Path) -> None:
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
    with pytest.raises(CoopenvError, match=r"^overrides: noise\.velosity: unknown key"):
        open_svea(path, None, {"noise.velosity": 1}, transport=Hub().connect())
    with pytest.raises(CoopenvError, match=r"^unknown environment 'gone'"):
        open_svea(path, "gone", transport=Hub().connect())
