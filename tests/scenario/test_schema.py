"""Contents of a scenario file: each mistake is one line that names the field, and the nearest valid word."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from coopenv.base.errors import ScenarioError
from coopenv.scenario import Scenario, parse_scenario
from tests.fuzz.scenarios import at, places
from tests.helpers import builders


def complete() -> dict[str, Any]:
    """Return a scenario that has every kind of section."""
    spline = [{"time": 0.0, "position": [9, 9, 0]}, {"time": 1.0, "position": [10, 9, 0]}]
    return builders.raw(
        [
            builders.vehicle(
                initial_estimate={"position_radius": 0.1},
                body={"size": [1, 1, 1]},
                goal={"position": [1, 1, 1]},
                motion={"kind": "driven"},
            ),
            builders.vehicle((5, 5, 0), motion={"kind": "segments", "segments": [{"duration": 1.0}]}),
            {"motion": {"kind": "waypoints", "waypoints": spline}},
        ],
        map={"origin": [0, 0, 0]},
        roads=[{"start": [0, 0], "end": [1, 1], "width": 1}],
        obstacles=[{"name": "B", "center": [50, 0, 0], "size": [1, 1, 1]}],
        **{
            name: {}
            for name in ("rates", "topology", "v2x", "observer", "dynamics", "observation", "action", "termination")
        },
        noise={"bearing": {}},
        reward={"weights": {}},
    )


def changed(path: str, value: Any, data: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return the data with one dotted key set."""
    result = copy.deepcopy(data or complete())
    node: Any = result
    *way, last = path.split(".")
    for part in way:
        node = node[int(part)] if isinstance(node, list) else node.setdefault(part, {})
    node[int(last) if isinstance(node, list) else last] = value
    return result


def complaint(data: dict[str, Any]) -> str:
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(data, "here.toml")
    text = str(caught.value)
    assert text.startswith("here.toml: ")
    assert "\n" not in text
    return text.removeprefix("here.toml: ")


def test_the_complete_scenario_is_valid() -> None:
    assert parse_scenario(complete(), "here").vehicle_names == ["vehicle_1", "vehicle_2", "vehicle_3"]


def test_unknown_keys_at_every_level() -> None:
    """Every key with a letter doubled: the line names its place and the right word."""
    whole = parse_scenario(complete(), "here").model_dump(mode="json", exclude_none=True)
    keys = [place for place in places(whole)[1:] if isinstance(place[-1], str) and len(place[-1]) > 2]
    assert len(keys) > 200
    for *where, key in keys:
        data, wrong = copy.deepcopy(whole), key[:2] + key[1:]
        node = at(data, where)
        node[wrong] = node.pop(key)
        text = complaint(data)
        assert f"{wrong}: unknown key (did you mean '{key}'?)" in text, (where, key)
        assert text.startswith(str(where[0]) if where else wrong)


def test_an_unknown_key_like_none_lists_what_is_allowed() -> None:
    assert (
        complaint(changed("topology.zzzzzz", 1)) == "topology.zzzzzz: unknown key; allowed: acyclic, mode, most_nearby"
    )


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("horizon", float("nan")),
        ("camera.orientation", [1, 1, 0, 0]),
        ("noise.bearing.axis", [0, 0, 0]),
        ("v2x.delay", 601),
        ("observer.k", 0.5),
        ("observer.k", [1.0, 0.4, 1.0]),
        ("observer.q", {"L1": -1}),
        ("observation.include", ["estimates"]),
        ("vehicles.0.body.size", [1, 0, 1]),
        ("vehicles.0.motion.kind", "flying"),
        ("vehicles.1.motion.segments.0.duration", 0),
        ("vehicles.2.motion.waypoints.1.time", 0.0),
        ("vehicles.2.motion.waypoints.0.time", 0.5),
        ("landmarks.0.motion", {"kind": "driven"}),
    ],
)
def test_impossible_values_are_refused_at_their_field(path: str, value: Any) -> None:
    """Some of each kind; bounds of all fields are in the published schema, see tests/runs/test_console.py."""
    text = complaint(changed(path, value))
    head = path.split(".")[0]
    assert text.startswith(head), text
    named = [part for part in path.split(".") if not part.isdigit()]
    assert named[-1] in text or named[-2] in text, text


@pytest.mark.parametrize(
    ("path", "value", "text"),
    [
        ("rates.camera", -60, "rates.camera: Input should be greater than or equal to 0.001, got -60"),
        ("rates.decision", 7, "rates.decision: the camera rate (60 Hz) must be a whole multiple of the decision rate"),
        ("rates.decision", 120, "whole multiple of the decision rate (120 Hz)"),
        ("observer.k", 0.4, "k: the observer is stable for k > 0.5 only (paper, definition of K_i)"),
        ("reward.weights.progress", 1.0, "reward.privileged: must be true"),
        ("vehicles.0.initial_pose.quaternion_wxyz", [1, 0, 0, 0], "give yaw or quaternion_wxyz, not both"),
        ("vehicles.2.initial_pose", {"position": [0, 0, 0]}, "a motion by waypoints starts at its first waypoint"),
        ("vehicles.0.initial_pose", None, "initial_pose: needed, with at least a position"),
        ("landmarks.0.name", "L2", "landmark name 'L2' is used twice"),
        ("landmarks.0.name", "vehicle_7", "landmark name 'vehicle_7' is reserved for vehicles"),
        ("vehicles.0.initial_estimate.orientation_offset_wxyz", [1, 0, 0, 1], "needs a unit quaternion"),
    ],
)
def test_the_line_names_the_mistake(path: str, value: Any, text: str) -> None:
    assert text in complaint(changed(path, value))


@pytest.mark.parametrize("missing", ["title", "horizon", "landmarks", "vehicles"])
def test_required_sections(missing: str) -> None:
    data = complete()
    del data[missing]
    assert missing in complaint(data)


def test_several_mistakes_are_counted() -> None:
    data = changed("rates.camera", -1, changed("v2x.loss", 2, changed("horizon", -1)))
    assert complaint(data).endswith("(and 2 more)")


def test_quaternions_are_normalised() -> None:
    data = changed("vehicles.0.initial_estimate.orientation_offset_wxyz", [0.7071, 0, 0, 0.7071])
    q = parse_scenario(data, "here").vehicles[0].initial_estimate.orientation_offset_wxyz
    assert sum(x * x for x in q) == pytest.approx(1.0, abs=1e-14)


def test_derived_counts_and_names() -> None:
    made: Scenario = parse_scenario(changed("horizon", 2.5, changed("rates.decision", 20)), "here")
    assert made.ticks_per_decision == 3
    assert made.horizon_ticks == 150
    assert made.target_names == ["L1", "L2", "L3", "L4", "vehicle_1", "vehicle_2", "vehicle_3"]
    assert made.driven
