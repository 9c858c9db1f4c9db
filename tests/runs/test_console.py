"""Progress, and what `describe`, the words and the JSON schema say about scenarios."""

from __future__ import annotations

import copy
import io
import json
import os
import tomllib
from contextlib import suppress
from pathlib import Path
from time import sleep
from typing import Any

import jsonschema
import pytest
from rich.console import Console

import coopenv
from coopenv.api.terms.layout import observation_layout
from coopenv.base.installation import data_directory
from coopenv.cli.app import main
from coopenv.estimation import compiled
from coopenv.report.terminal import Terminal
from coopenv.runs import console as module
from coopenv.runs.console import Progress, compile_notice, note_overwritten
from coopenv.runs.scenario_text import IMAGE_FIELDS, settings
from coopenv.runs.summary import describe_scenario
from coopenv.scenario import parse_scenario
from coopenv.scenario.files import apply_vehicle_defaults, schema_text
from coopenv.world import launch
from tests.helpers.commands import printed
from tests.helpers.env_suite import ALIKE, each_slow
from tests.helpers.four_way import FOUR_WAY


@pytest.fixture
def text(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    monkeypatch.setattr(module, "LINE_PERIOD", 0.01)
    return io.StringIO()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time of the progress, s, which a test sets."""
    now = [100.0]
    monkeypatch.setattr(module, "monotonic", lambda: now[0])
    return now


def wait_for(text: io.StringIO, words: str) -> None:
    """Wait until a line says so; the line is written by another thread."""
    while words not in text.getvalue():
        sleep(0.005)


def test_lines_where_there_is_no_terminal(text: io.StringIO, clock: list[float]) -> None:
    with Progress(Console(file=text, width=20), "simulating a long name", total=4) as progress:
        clock[0] = 120.0
        wait_for(text, "simulating a long name: 20 s\n")
        progress.update(1)  # the first part took longer than others, as it compiled something
        wait_for(text, "simulating a long name: 25 % after 20 s\n")
        clock[0] = 130.0
        progress.advance("drawing")
        wait_for(text, "drawing: 50 % after 30 s, about 20 s left\n")


def test_processes_that_finish_together_are_one_part(text: io.StringIO, clock: list[float]) -> None:
    with Progress(Console(file=text), "comparing", total=20) as progress:
        for clock[0] in (159.0, 160.0):
            progress.advance()
        assert progress.line() == "comparing: 10 % after 60 s"
        for clock[0] in (219.0, 220.0):
            progress.advance()
        assert progress.line() == "comparing: 20 % after 120 s, about 480 s left"


def test_time_counts_from_the_first_word(text: io.StringIO, clock: list[float]) -> None:
    with Progress(Console(file=text), "starting", total=1.0) as progress:
        for clock[0] in (103.0, 110.0):
            progress.update(0.0, "watching peek")
        assert progress.line() == "watching peek: 7 s"


def test_a_notebook_that_asks_for_colours_gets_lines(text: io.StringIO) -> None:
    with Progress(Console(file=text, force_terminal=True), "simulating"):
        wait_for(text, "simulating: ")
    assert "\r" not in text.getvalue() and "\x1b[2K" not in text.getvalue()


def test_time_left_is_not_reported_before_there_is_enough_to_go_by(
    text: io.StringIO, clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "HINT_FROM", 20.0)
    progress = Progress(Console(file=text), "simulating", total=400)
    progress.__enter__()
    clock[0] = 103.0  # until it begins
    progress.update(0)
    clock[0] = 103.5
    progress.update(1)
    assert progress.line() == "simulating: 0 % after 0 s"
    monkeypatch.setattr(module, "LINE_PERIOD", 10.0)
    clock[0] = 104.8  # of a slow beginning
    assert progress.line() == "simulating: 0 % after 2 s"
    clock[0] = 105.4
    progress.update(20)  # 19 more in 1.9 s
    progress.__exit__()
    assert "simulating: 5 % after 2 s, about 38 s left\n" in text.getvalue()
    assert "left" not in text.getvalue().partition("simulating: 5 %")[0]


def test_in_real_time_the_time_left_is_known(text: io.StringIO, clock: list[float]) -> None:
    with Progress(Console(file=text), "running", total=480, rate=60.0) as progress:
        progress.update(0)
        progress.update(3)
        assert progress.line() == "running: 1 % after 0 s, about 8 s left"


def test_quick_work_says_nothing_where_there_is_no_terminal() -> None:
    text = io.StringIO()
    with Progress(Console(file=text), "quick", total=1) as progress:
        progress.update(1)
    assert text.getvalue() == ""


def test_a_terminal_has_a_bar_that_vanishes() -> None:
    master, slave = os.openpty()
    stream = os.fdopen(slave, "w")
    with stream, Progress(Console(file=stream, force_terminal=True, width=80), "simulating", total=2) as progress:
        progress.update(1)
    parts = []
    with suppress(OSError):  # of Linux, where the other end is closed
        while part := os.read(master, 4096):
            parts.append(part)
    os.close(master)
    text = b"".join(parts).decode()
    assert "simulating" in text and " % after" not in text
    assert text.endswith("\x1b[2K")


def test_an_error_ends_the_lines(text: io.StringIO) -> None:
    with pytest.raises(KeyboardInterrupt), Progress(Console(file=text), "work") as progress:
        raise KeyboardInterrupt
    progress._lines.join(5.0)
    assert not progress._lines.is_alive()


@pytest.fixture
def looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[set[str]]:
    """Let kernels be kept in a folder of their own, with one in it, and return a list of what is found there."""
    looked: list[set[str]] = []
    modules = launch.modules

    def look() -> set[str]:
        looked.append(modules())
        return looked[-1]

    monkeypatch.setattr(module, "COMPILE_NOTICE_AFTER", 0.001)
    monkeypatch.setattr(launch, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(launch, "modules", look)
    (tmp_path / "wp_known_0123456").mkdir()
    return looked


def test_compiling_is_reported_once(looks: list[set[str]], tmp_path: Path) -> None:
    text = io.StringIO()
    with compile_notice(Console(file=text)):
        (tmp_path / "wp_new_0123456_p1_t2").mkdir()
        wait_for(text, "compiling kernels (once per machine) ...\n")
        (tmp_path / "wp_newer_0123456").mkdir()
    assert text.getvalue().count("compiling") == 1


def test_loading_what_is_in_the_cache_is_not_compiling(looks: list[set[str]]) -> None:
    text = io.StringIO()
    with compile_notice(Console(file=text)):
        while len(looks) < 10:
            sleep(0.001)
    assert text.getvalue() == ""


def test_functions_of_observers_on_the_host_are_compiled_as_well(
    looks: list[set[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    text, fresh = io.StringIO(), ["found_before"]
    monkeypatch.setattr(compiled, "fresh", fresh)
    with compile_notice(Console(file=text)):
        while len(looks) < 10:
            sleep(0.001)
        assert text.getvalue() == ""
        fresh.append("new")
        wait_for(text, "compiling kernels (once per machine) ...\n")


DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "scenario.schema.json"


def described(name: str, width: int, **overrides: Any) -> str:
    return printed(*describe_scenario(coopenv.load_scenario(name, overrides)), width=width)


@pytest.mark.parametrize("name", each_slow(coopenv.list_envs(), *ALIKE))
def test_everything_fits_and_nothing_is_cut_off(name: str) -> None:
    text = described(name, 80)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    assert "…" not in text
    tokens = set(text.split())
    scenario = coopenv.load_scenario(name)
    for section in (scenario.camera, scenario.noise, scenario.v2x, scenario.observer, scenario.observation):
        for key, _, meaning, _ in settings(section):
            assert key in tokens
            assert set(meaning.split()) <= tokens, key
    for field, layout in observation_layout(scenario).items():
        assert field in tokens
        assert f"{layout.start}:{layout.stop}" in tokens
        assert set(layout.meaning.split()) <= tokens | {token.rstrip(";") for token in tokens}  # a center follows
    assert set(scenario.target_names) <= {token.strip(",") for token in tokens}


def test_settings_of_the_image_are_left_out_where_there_is_none() -> None:
    keys = {name: [key for key, *_ in settings(coopenv.load_scenario(name).camera)] for name in coopenv.list_envs()}
    assert coopenv.load_scenario("busy_intersection").camera.model == "omnidirectional"
    assert not set(IMAGE_FIELDS) & set(keys["busy_intersection"])
    assert {"model", "position", "orientation", "miss_probability"} <= set(keys["busy_intersection"])
    assert set(IMAGE_FIELDS) <= set(keys["crossing_path"])
    assert "principal_point" not in described("busy_intersection", 100)


def test_overrides_are_described(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe", "busy_intersection", "--all", "--set", "v2x.loss=0.25"]) == 0
    assert any(line.split()[:3] == ["loss", "*", "0.25"] for line in capsys.readouterr().out.splitlines())


def test_scenario_texts_are_not_read_as_markup() -> None:
    assert "[bold]loud[/bold]" in described("busy_intersection", 80, title="[bold]loud[/bold]")


def test_the_published_schema_is_up_to_date() -> None:
    published, current = (plain_schema(json.loads(text)) for text in (DOCUMENT.read_text(), schema_text()))
    assert published == current, "run: coopenv schema --out docs/scenario.schema.json"


def plain_schema(part: Any) -> Any:
    """Return a schema without what some versions of pydantic say twice: lists of one, and an enum beside its const."""
    if isinstance(part, list):
        return [plain_schema(item) for item in part]
    if not isinstance(part, dict):
        return part
    if len(part.get("allOf", ())) == 1:
        part = {**part.pop("allOf")[0], **part}
    return {key: plain_schema(value) for key, value in part.items() if not (key == "enum" and "const" in part)}


def test_schema_to_standard_output_and_to_a_file(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["schema"]) == 0
    assert capsys.readouterr().out == schema_text()
    assert main(["schema", "--out", str(tmp_path / "schema.json")]) == 0
    assert (tmp_path / "schema.json").read_text() == schema_text()


@pytest.fixture(scope="module")
def validator() -> Any:
    schema = json.loads(schema_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def raw(path: Path | str) -> dict[str, Any]:
    return tomllib.loads(Path(path).read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", coopenv.list_envs())
def test_every_environment_satisfies_the_schema(name: str, validator: Any) -> None:
    assert [error.message for error in validator.iter_errors(raw(data_directory("envs") / f"{name}.toml"))] == []


@pytest.mark.parametrize(
    "path",
    [
        (),
        ("camera",),
        ("noise", "bearing"),
        ("vehicle_defaults",),
        ("vehicle_defaults", "body"),
        ("vehicle_defaults", "initial_pose"),
        ("vehicles", 0),
        ("vehicles", 0, "initial_pose"),
        ("vehicles", 0, "goal"),
        ("landmarks", 0),
        ("obstacles", 0),
        ("reward", "weights"),
        ("termination",),
    ],
)
def test_the_schema_refuses_unknown_keys_as_the_loader_does(path: tuple[Any, ...], validator: Any) -> None:
    document = raw(FOUR_WAY)
    node: Any = document
    for part in path:
        node = node.setdefault(part, {}) if isinstance(part, str) else node[part]
    node["misspelt"] = 1
    assert not validator.is_valid(document)
    with pytest.raises(coopenv.ScenarioError, match="misspelt"):
        parse_scenario(apply_vehicle_defaults(copy.deepcopy(document)), "four_way")


def test_vehicles_may_leave_out_what_the_defaults_say(validator: Any) -> None:
    document = raw(FOUR_WAY)
    document["vehicle_defaults"]["goal"] = {"position": [5.0, 5.0, 0.0]}
    for vehicle in document["vehicles"]:
        vehicle["goal"] = {"radius": 1.0}
    parse_scenario(apply_vehicle_defaults(copy.deepcopy(document)), "four_way")
    assert validator.is_valid(document)
    del document["horizon"]
    assert not validator.is_valid(document)


@pytest.mark.parametrize(
    ("facts", "words"),
    [('{"seed": 3, "environment": "facade"}', "seed 3"), ("[]", "an earlier result"), ("", "an earlier")],
)
def test_an_overwritten_result_is_printed_in_one_line(
    facts: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "metrics.json").write_text(facts)
    log = Terminal(width=200)
    note_overwritten(tmp_path, ["other.json", "metrics.json"], log)
    note_overwritten(None, ["metrics.json"], log)
    note_overwritten(tmp_path, ["other.json"], log)
    [line] = capsys.readouterr().out.splitlines()
    assert line.startswith(f"overwrites {words}") and line.endswith(f" in {tmp_path}")


def test_a_bar_has_no_end_before_its_results_are_written(clock: list[float]) -> None:
    with Progress(Console(file=io.StringIO()), "simulating", total=4) as progress:
        progress.update(2)
        clock[0] = 113.0
        progress.update(4)
        assert progress.line() == "simulating: 99 % after 13 s, results follow"
        assert progress._bar.tasks[0].completed < 4
