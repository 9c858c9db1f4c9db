"""Finding, reading and overriding scenario files."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

import pytest

from coopenv.base.errors import ScenarioError, UnknownEnvironmentError
from coopenv.scenario import load_scenario, scenario_name

MINIMAL = """
title = "t"
horizon = 5.0
landmarks = [
    { name = "A", position = [3.0, 0.0, 1.0] },
    { name = "B", position = [0.0, 3.0, 1.0] },
    { name = "C", position = [-3.0, 0.0, 1.0] },
]
[vehicle_defaults]
body.size = [1.0, 0.5, 0.5]
initial_estimate = { position_radius = 0.3, orientation_angle = 0.1 }
motion = { kind = "driven" }
goal.position = [9.0, 0.0, 0.0]
[[vehicles]]
initial_pose.position = [0.0, 0.0, 0.0]
[[vehicles]]
initial_pose.position = [0.0, -2.0, 0.0]
initial_estimate.position_radius = 2.0
body = { size = [2.0, 2.0, 2.0], center = [1.0, 0.0, 0.0] }
goal.radius = 0.7
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(MINIMAL)
    return path


def test_unknown_names_and_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnknownEnvironmentError, match=r"unknown environment 'busy'.*known: .*busy_intersection"):
        load_scenario("busy")
    with pytest.raises(UnknownEnvironmentError, match=r"did you mean 'busy_intersection'"):
        load_scenario("busy_intersecton")
    with pytest.raises(UnknownEnvironmentError, match=r"no such scenario file: .*gone.toml"):
        load_scenario(tmp_path / "gone.toml")
    with pytest.raises(UnknownEnvironmentError, match=r": a folder; expected a scenario \(\.toml\)"):
        load_scenario(str(tmp_path) + "/")
    with pytest.raises(UnknownEnvironmentError, match=r"notes\.txt': a file of an unknown kind; expected a scenario"):
        (tmp_path / "notes.txt").touch()
        monkeypatch.chdir(tmp_path)
        load_scenario("notes.txt")
    os.mkfifo("pipe.toml")
    with pytest.raises(UnknownEnvironmentError, match=r"pipe\.toml: neither a file nor a folder; expected a scenario"):
        load_scenario("pipe.toml")


@pytest.mark.parametrize("name", ["~nosuchuser/x.toml", "a" * 5000 + ".toml", "x\0.toml", "/" + "a/" * 5000])
def test_names_that_no_file_can_have(name: str) -> None:
    with pytest.raises(UnknownEnvironmentError, match="no such scenario file: ") as caught:
        load_scenario(name)
    assert len(str(caught.value)) < 400
    with pytest.raises(UnknownEnvironmentError, match=r"unknown environment 'aaa.*aaa'"):
        load_scenario("a" * 5000)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a = ", "not valid TOML"),
        (b"\xff\xfe = 1", "not a text file"),
        (b"a = " + b"[" * 2000 + b"]" * 2000, "lists or tables stand too deep in one another"),
        (b"a = " + b"[" * 300 + b"]" * 300, "lists or tables stand too deep in one another|a: unknown key"),
        (b"a." * 3000 + b"a = 1", r"not valid TOML: 'a\.a.*: a dotted key of more than 16 parts"),
        (b"#" * 9_000_000, "larger than 4 MiB"),
        (b'title = "\\u001b]0;owned\\u0007"', r"title: control characters are not allowed, got '\\x1b]0;owned\\x07'"),
        (b'"\\u001b[2J" = 1\ntitle = "t"', r"\\x1b\[2J: unknown key"),
        (b'title = 5\ndescription = "' + b"a" * 11_000 + b'"', "title: Input should be a valid string, got 5"),
        (b'title = "t"\ndescription = "' + b"a" * 11_000 + b'"', "description: .*at most 10000 characters, got 'aaa"),
        (b'title = "t"\nhorizon = "' + b"a" * 5000 + b'"', r"horizon: Input should be a valid number, got"),
    ],
)
def test_broken_files(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "broken.toml"
    path.write_bytes(content)
    with pytest.raises(ScenarioError, match=f"broken.toml: {words}") as caught:
        load_scenario(path)
    assert len(str(caught.value)) < 400 and str(caught.value).isprintable()


def circular() -> dict[str, Any]:
    table: dict[str, Any] = {}
    table["a"] = table
    return table


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("vehicles.\u00b2.goal.radius", 1.0, r"override 'vehicles.\u00b2.goal.radius': no entry '\u00b2'"),
        ("vehicles." + "9" * 5000, 1.0, "no entry '9{27}...9{27}'"),
        (".".join("a" * 3000), 1, "too deep in one another"),
        ("noise", {("a", 1): 2}, "keys must be str"),
        ("noise", circular(), "Circular reference|too deep"),
        ("noise.velocity", 10**5000, "Exceeds the limit"),
        ("noise.velocity", "\ud800", "Invalid JSON: .* hex escape"),
        ("title", "\x1b[2J", "control characters"),
        ("noise-enabled", False, "noise-enabled: unknown key"),
        ("vehicles.0.motion", {"kind": None, "knd": "constant"}, r"motion.kind"),
        ("rates.decision", 1e-9, "rates.decision"),
        ("horizon", "5", "horizon: Input should be a valid number"),
        ("observer.k", True, "observer.k"),
        ("v2x.period", 2**32, "v2x.period"),
    ],
    ids=lambda value: ascii(value)[1:20] if isinstance(value, str) else "value",
)
def test_invalid_overrides_are_refused(file: Path, key: str, value: Any, words: str) -> None:
    with pytest.raises(ScenarioError, match=words) as caught:
        load_scenario(file, {key: value})
    assert len(str(caught.value)) < 400 and str(caught.value).isprintable()


def test_vehicle_defaults_merge_below_each_vehicle(file: Path) -> None:
    first, second = load_scenario(file).vehicles
    assert first.body is not None
    assert second.body is not None
    assert (first.body.size, second.body.size) == ((1.0, 0.5, 0.5), (2.0, 2.0, 2.0))
    assert second.body.center == (1.0, 0.0, 0.0)
    assert (first.initial_estimate.position_radius, second.initial_estimate.position_radius) == (0.3, 2.0)
    assert second.initial_estimate.orientation_angle == 0.1
    assert first.motion.kind == second.motion.kind == "driven"
    assert first.goal is not None
    assert second.goal is not None
    assert (first.goal.radius, second.goal.radius) == (0.5, 0.7)
    assert second.goal.position == (9.0, 0.0, 0.0)


def test_unknown_keys_in_the_defaults_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(MINIMAL.replace("body.size", "bodi.size"))
    with pytest.raises(ScenarioError, match=r"bad.toml: vehicles.0.bodi: unknown key \(did you mean 'body'"):
        load_scenario(path)


def get(value: Any, path: str) -> Any:
    for part in path.split("."):
        value = value[int(part)] if part.isdigit() else getattr(value, part)
    return value


@pytest.mark.parametrize(
    ("key", "value", "where", "expected"),
    [
        ("noise.enabled", False, "noise.enabled", False),
        ("noise.bearing.scale", 0.01, "noise.bearing.scale", 0.01),
        ("observer.k", [1, 2], "observer.k", (1.0, 2.0)),
        ("observer.q", {"A": 3}, "observer.q", {"A": 3.0}),
        ("vehicles.0.goal.radius", 0.9, "vehicles.0.goal.radius", 0.9),
        ("vehicles.vehicle_2.goal.radius", 0.9, "vehicles.1.goal.radius", 0.9),
        ("vehicles.vehicle_2.goal.radius", 0.9, "vehicles.0.goal.radius", 0.5),
        ("landmarks.B.position", [0, 4, 1], "landmarks.1.position", (0.0, 4.0, 1.0)),
        ("v2x.delay", 3, "v2x.delay", 3),
        ("vehicles.0", {"initial_pose": {"position": [5, 5, 5]}}, "vehicles.0.initial_pose.position", (5.0, 5.0, 5.0)),
    ],
)
def test_overrides(file: Path, key: str, value: Any, where: str, expected: Any) -> None:
    assert get(load_scenario(file, {key: value}), where) == expected


def test_a_missing_file_of_sumo_names_the_scenario_once(file: Path) -> None:
    file.write_text(MINIMAL.replace("horizon", 'backend = "sumo"\nsumo.net = "none.net.xml"\nhorizon', 1))
    with pytest.raises(ScenarioError, match=r"^mine\.toml: sumo\.net: .*none\.net\.xml'?: No such file") as failed:
        load_scenario(file)
    assert str(failed.value).count("mine.toml") == 1


def test_star_means_every_entry_and_later_overrides_win(file: Path) -> None:
    every = {"vehicles.*.goal.radius": 0.9, "vehicles.*.initial_estimate.position_radius": 0.0}
    made = load_scenario(file, {**every, "vehicles.1.goal.radius": 1.1})
    assert [v.goal.radius for v in made.vehicles if v.goal] == [0.9, 1.1]
    assert [v.initial_estimate.position_radius for v in made.vehicles] == [0.0, 0.0]
    assert [v.body.size[0] for v in made.vehicles if v.body] == [1.0, 2.0]


def test_a_dict_is_what_its_file_is(file: Path) -> None:
    raw = tomllib.loads(MINIMAL)
    assert load_scenario(raw) == load_scenario(file)
    changes = {"vehicles.*.goal.radius": 0.9, "landmarks.A.position": [1, 1, 1]}
    assert load_scenario(raw, changes) == load_scenario(file, changes)
    assert raw == tomllib.loads(MINIMAL)
    whole = load_scenario(file)
    assert load_scenario(whole.model_dump()) == whole
    assert repr(whole) == "Scenario('t', vehicles=2, landmarks=3, observer='riccati', horizon=5.0)"
    assert (scenario_name(raw), scenario_name(whole), scenario_name(file)) == ("t", "t", "mine")
    assert scenario_name({"title": " A b/c "}) == "A_b_c"


@pytest.mark.parametrize(
    ("wrong", "changes", "words"),
    [
        ({}, {}, "^scenario: title: Field required"),
        ({"horizn": 2.0}, {}, r"^scenario: horizn: unknown key \(did you mean 'horizon'"),
        (tomllib.loads(MINIMAL), {"horizn": 2.0}, r"^overrides: horizn: unknown key"),
        (3, {}, "^environment: expected a name, a path, a dict of its keys or a Scenario, got int"),
    ],
)
def test_objects_that_are_no_scenarios_are_refused(wrong: Any, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        load_scenario(wrong, changes)


def test_overrides_do_not_leak_into_the_next_load(file: Path) -> None:
    before = load_scenario(file)
    load_scenario(file, {"vehicles.*.goal.radius": 0.9, "noise.enabled": False, "landmarks.A.position": [1, 1, 1]})
    assert load_scenario(file) == before
    shared = load_scenario(file, {"vehicles.0.body.size": [2.5, 2, 2]})
    assert shared.vehicles[1].body is not None
    assert shared.vehicles[1].body.size == (2.0, 2.0, 2.0)


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("noise.enabld", r"noise.enabld: unknown key \(did you mean 'enabled'"),
        ("nois.enabled", r"nois: unknown key \(did you mean 'noise'"),
        ("vehicles.7.goal.radius", r"override 'vehicles.7.goal.radius': no entry '7' \(there are 2; 0..1 or \*\)"),
        ("vehicles.vehicle_3.goal.radius", r"no entry 'vehicle_3'"),
        ("landmarks.D.position", r"no entry 'D'"),
        ("horizon.length", r"override 'horizon.length': 'length' lies below a plain value"),
    ],
)
def test_wrong_overrides(file: Path, key: str, words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        load_scenario(file, {key: 1.0})


def test_a_deep_copy_shares_no_section() -> None:
    scenario = load_scenario("facade")
    shallow, deep = (scenario.model_copy(update={"horizon": 3.0}, deep=deep) for deep in (False, True))
    assert shallow == deep and shallow.horizon == 3.0
    assert shallow.camera is scenario.camera and deep.camera is not scenario.camera
