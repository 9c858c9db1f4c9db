"""`coopenv view | film` and the pages of other commands: what they write, and what they say of bad input."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from PIL import Image

from coopenv.base.installation import data_directory
from coopenv.cars.fake.fleet import fakes
from coopenv.cli.app import main
from coopenv.cli.options import has_display
from tests.helpers.commands import refused
from tests.helpers.processes import COOPENV, start

pytest.importorskip("viser", reason="needs the extra view")
SHORT = ("overtaking", "--set", "horizon=1.0")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("coopenv.viz.figures.FIGURE_NAMES", ())  # pages are asked for here
    return tmp_path


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with files that are cut off, or no recordings at all, and with a run without its scene."""
    place = tmp_path_factory.mktemp("broken")
    (place / "others.mcap").write_bytes(b"\x89MCAP0\r\nnothing")
    log, run = place / "cut.mcap", place / "run"
    assert main(["record", *SHORT, "--no-scene", "--no-replay", "--out", str(log)]) == 0
    assert main(["run", *SHORT, "--no-figures", "--out", str(run)]) == 0
    log.write_bytes(log.read_bytes()[:5000])
    (place / "cut.npz").write_bytes((run / "scene.npz").read_bytes()[:5000])
    (run / "scene.npz").unlink()
    return place


def test_a_run_can_be_watched_and_filmed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *SHORT, "--out", "there", "--policy", "zero"]) == 0
    printed = capsys.readouterr()
    assert printed.out.endswith("To watch it in a browser, open there/replay.html\n")
    assert main(["film", "there", "--out", "film.webp", "--fps", "4"]) == 0
    assert capsys.readouterr().out.startswith("film.webp: 5 pictures, 1.25 s")
    Path("there/scene.npz").unlink()
    assert "has no scene.npz, which `coopenv run` writes" in refused("film", "there", "--out", "film.webp")


def test_several_films_stand_side_by_side(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["film", *SHORT, "--observer", "riccati,mekf", "--fps", "2"]
    assert main([*command, "--map-only", "--headings", "one, another", "--out", "above.webp"]) == 0
    assert "--headings: expected one for each of 2 films, got 1" in refused(
        *command, "--headings", "x", "--out", "x.gif"
    )
    pytest.importorskip("pyvista", reason="needs the extra film3d")
    space = ["--3d", "--camera", "overview,driver", "--width", "320", "--vehicle", "f2"]
    assert main([*command, *space, "--out", "space.webp"]) == 0
    with Image.open("space.webp") as film:
        assert film.n_frames == 3 and film.size == (320, 20 + 120 + 120)
    assert "unknown camera of a film 'above'" in refused(*command, "--3d", "--camera", "above", "--out", "x.gif")


def test_a_recording_has_its_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", *SHORT, "--out", "drive.mcap"]) == 0
    assert capsys.readouterr().out.endswith("drive.html: the episode, to watch in a browser\n")
    Path("drive.mcap").unlink()
    assert "drive.html: exists already; --force replaces it" in refused("record", *SHORT, "--out", "drive.mcap")
    assert main(["record", *SHORT, "--out", "drive.mcap", "--no-replay"]) == 0
    assert main(["film", "drive.mcap", "--observer", "mekf", "--out", "film.gif", "--fps", "2"]) == 0


def test_without_the_extra_runs_say_what_is_missing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["run", *SHORT, "--out", "there"]) == 0
    captured = capsys.readouterr()
    assert "note: no replay.html: pages in the browser need an extra: pip install '.[view]'" in captured.err
    assert "To watch it" not in captured.out and not Path("there/replay.html").exists()
    assert "error: pictures in the browser need an extra: pip install '.[view]' (" in refused("view", "overtaking")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["view", "overtaking", "--vehicle", "f7"], "--vehicle f7: no such vehicle"),
        (["view", "overtaking", "--observer", "robost"], "unknown observer 'robost' (did you mean 'robust'?)"),
        (["view", "svea"], "--deployment: needed by coopenv view svea"),
        (["view", "overtaking", "--deployment", "x.toml"], "--deployment x.toml: is for coopenv view svea"),
        (["view", "overtaking", "--connect", "tcp/127.0.0.1:1"], "--connect tcp/127.0.0.1:1: is for coopenv view svea"),
        (["view", "cut.npz"], "cut.npz: not a readable scene: it is cut off"),
        (["view", "cut.mcap"], "cut.mcap: cut off"),
        (["view", "scene.npz"], "scene.npz: not a readable scene"),
        (["view", "others.mcap", "--agent", "peek"], "--agent: is for a simulation, others.mcap is recorded"),
        (["view", "overtaking", "--host", "192.0.2.7"], "--host 192.0.2.7: is no address of this computer"),
        (["film", "overtaking", "--out", "film.avi"], "film.avi: unknown format of a film"),
        (["film", "overtaking", "--out", "film.gif", "--camera", "driver"], "--camera: is for a 3-D film, with --3d"),
        (["film", "overtaking", "--out", "film.gif", "--3d", "--map-only"], "--map-only: is for a film from above"),
        (["film", "overtaking", "--out", "others.mcap/film.gif"], "others.mcap/film.gif: others.mcap is not a folder"),
        (["view", "run"], "run: has no scene.npz"),
        (["export", "run", "--out", "others.mcap/tum"], "a part of its path is not a folder"),
        (["figures", "run", "--out", "others.mcap"], "cannot write to others.mcap: it is not a folder"),
        (["export", "cut.mcap", "--format", "foxglove-layout"], "cut.mcap: cut off"),
        (["export", "run", "--format", "foxglove-layout"], "run: a folder; expected a log file (.mcap)"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], message: str, broken: Path) -> None:
    shutil.copytree(broken, ".", dirs_exist_ok=True)
    assert message in refused(*arguments)


def test_without_a_display_no_browser_is_opened(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr("webbrowser.open", lambda url: pytest.fail(f"opened {url}"))
    assert not has_display()
    assert main(["run", "crossing_path", *SHORT[1:], "--out", "there", "--open"]) == 0
    monkeypatch.setenv("DISPLAY", ":0")
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or len(opened) == 1)
    capsys.readouterr()
    overwritten = "overwrites seed 0 in there\n"
    for said in (overwritten, f"{overwritten}note: there is no browser to open there/replay.html\n"):
        assert main(["run", "crossing_path", *SHORT[1:], "--out", "there", "--open"]) == 0
        assert capsys.readouterr().err == said
    assert opened == 2 * [(Path.cwd() / "there" / "replay.html").as_uri()]


def test_a_folder_does_not_take_the_place_of_an_environment() -> None:
    """A run that was kept as `overtaking` is ./overtaking; `overtaking` is the environment, which can be changed."""
    assert main(["run", *SHORT, "--no-figures", "--out", "overtaking"]) == 0
    assert main(["film", *SHORT, "--fps", "1", "--out", "film.gif"]) == 0
    assert main(["run", "overtaking", "--steps", "2", "--no-figures", "--out", "again"]) == 0
    Path("crossing_path").mkdir()
    Path("crossing_path/metadata.yaml").touch()  # as a bag has it
    assert main(["run", "crossing_path", "--steps", "2", "--no-figures", "--out", "again"]) == 0
    assert main(["film", "./overtaking", "--fps", "1", "--out", "film.gif"]) == 0
    error_text = refused("film", "./overtaking", "--set", "horizon=1.0", "--out", "film.gif")
    assert "./overtaking has been run" in error_text
    refused("run", "./crossing_path", "--no-figures", "--out", "again")


def test_the_view_serves_on_loopback_until_it_is_ended(folder: Path) -> None:
    process = start((*COOPENV, "view", *SHORT, "--no-browser"), folder)
    assert process.stdout is not None
    url = process.stdout.readline().split()[0]
    assert url.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(url, timeout=20) as answer:
        assert b"<html" in answer.read(2000)
    assert "another program listens there" in refused("view", *SHORT, "--port", str(urlsplit(url).port))
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 130 and "Traceback" not in errors


@pytest.mark.slow
def test_cars_are_watched_where_they_are(folder: Path) -> None:
    """Fake cars, their router and the view are processes of their own; a program reads what a browser would be sent."""
    connect = pytest.importorskip("websockets.sync.client", reason="needs the extra 'view'").connect
    viser = pytest.importorskip("viser", reason="needs the extra 'view'")
    fleet = data_directory("examples/fleet") / "overtaking.toml"
    with fakes(fleet, None, 0) as router:
        command = (*COOPENV, "view", "svea", "--deployment", str(fleet), "--connect", router, "--no-browser")
        process = start(command, folder)
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "http" in line, process.communicate()
        address = line.split()[0].replace("http", "ws")
        versions = [f"viser-v{viser.__version__}"]
        with connect(address, subprotocols=versions, max_size=None) as link:
            moved = [message for message in (link.recv(timeout=30) for _ in range(40)) if isinstance(message, bytes)]
        assert len(moved) == 40
        os.kill(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in errors, errors
