"""Pages of the reference that are made from docstrings: `python -m sitegen.reference` writes them to docs/reference."""

from collections.abc import Callable, Iterator
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from coopenv.base.installation import list_envs
from coopenv.base.sections import Section
from coopenv.cars.bags.topic_map import TopicMap
from coopenv.cars.deployment import Deployment
from coopenv.cars.profile import SVEA, CarProfile, Role
from coopenv.runs.page import table
from coopenv.scenario.terms import OBSERVATION_FIELDS, REWARD_TERMS
from coopenv.training.settings import Settings
from sitegen.mirror import ROOT

OBSERVATION = """# What each observation entry means

<!-- Written by `python -m sitegen.reference`. -->

An observation holds what one vehicle knows: its own estimate, the measurements of its camera, and received messages. No
entry uses the truth. An entry is (value - center) / scale, clipped to [-1, 1], or to [0, 1] if it cannot be negative.
`observation.scales.NAME` and `observation.centers.NAME` change both for one field.

`coopenv describe ENV` prints the layout of an environment. In a program:

```python
import coopenv
from coopenv.api.terms.layout import observation_layout

layout = observation_layout(coopenv.load_scenario("open_square"))
goal = layout["goal"]
print(layout.size, goal.start, goal.stop, goal.unit, goal.meaning)
```

With `parallel_env(name, observation="dict")` an observation is a dictionary by field name instead of one vector.

The tables below hold every field by group. *One per*: the vehicle itself, every target (landmarks, then vehicles),
every neighbour, or each of the nearest landmarks of the map. *Planar* is the number of entries that
`observation.planar = true` keeps. `observation.include` of a scenario chooses groups or single fields.
[Terms](../terms.md) shows how to add a field of your own.

The layout of each environment, with sizes, scales and centers:
"""

DEPLOYMENT = """# Deployment file of cars

<!-- Written by `python -m sitegen.reference`. -->

A deployment file lists the cars of a fleet, their network and their limits. [Cars](../cars.md) shows how to use one;
[`examples/fleet`](../../examples/fleet) has three. Paths are relative to the file. Unknown keys are refused.

`--connect ENDPOINT` of `coopenv svea run` and `fake`, and `connect=` of `parallel_env`, replace `network.connect`;
that of `coopenv svea gate` and `health` replaces `gate.connect`. `[[cars]]` is one table per car; `cars.name` is a key.
"""


TOPIC = """# Topics of cars

<!-- Written by `python -m sitegen.reference`. -->

These are the topics of SVEA, `coopenv/cars/profiles/svea.toml`. They are below `fleet/CAR/`, in CDR as
zenoh-bridge-ros2dds sends it: the Zenoh key is the ROS name without its leading slash. Motion capture is
`fleet/qualisys/CAR/odom`. Presence is a Zenoh liveliness token, `fleet/alive/NAME`. Rates are those of
[fake cars](../fake_cars.md). Messages above the maximal age are not used. Bearings in messages point from the target to
the camera, in the optical frame.

`network.kind = "nats"` or `"ros1"` is for the authors' cars with their names: `agentN.riccatiPoint`,
`/agentN/pixy_node/objectsInfo`, `/agentN/actuation_twist`, `/qualisys/CAR/odom`, `/agentN/lli/ctrl_request`.

"""

PROFILE = """## Profile of a make

A profile is one TOML file with the keys below; `topics.KEY` is `topics.ROLE.KEY`. Roles and an example are in
`svea.toml`. A deployment file names its profile (`profile = "my_make.toml"`), the map of a bag too (`names`).

"""

TOPIC_ROWS = {
    Role.DETECTIONS: ("car", "60", "blocks of the Pixy, pixels; also frames without blocks"),
    Role.BEARINGS: ("car", "60", "the authors' unit vectors, instead of pixels"),
    Role.CAMERA_INFO: ("car", "1", "calibration, compared with the environment's before arming"),
    Role.ODOMETRY: ("car", "20", 'the car\'s own filter; its twist is used with `odometry = "odometry"`'),
    Role.WHEEL: ("car", "50", "wheel speed"),
    Role.IMU: ("car", "100", "turn rate"),
    Role.ESTIMATE: ("station, car", "20, 60", "estimated pose of a vehicle; position of a moving landmark, 60 Hz"),
    Role.REPORT: ("station", "20", "message of the observer `robust`"),
    Role.POINT: ("car", "60", "position alone, the authors' `riccatiPoint`"),
    Role.STATE: ("car", "5", "whether PX4 is armed; its mode"),
    Role.REMOTE: ("car", "5", "remote control"),
    Role.BATTERY: ("car", "5", "remaining share"),
    Role.COMMAND: ("station", "20", "steering angle, speed, acceleration; `frame_id` is SESSION:NUMBER"),
    Role.ARM: ("station", "once", "arms and disarms the gate"),
    Role.GATE: ("gate", "5", "state, nonce, refused commands by reason"),
    Role.STOP: ("any", "-", "emergency stop"),
    Role.MANUAL: ("gate", "20", "command to PX4: `y` = -10 % steering, `z` = 500 - 5 % speed"),
    Role.TRUTH: ("motion capture", "100", "true pose, for infos, metrics and safety, never for observations"),
}
"""Sender, rate (of fake cars, Hz) and content of the topics of a car."""

BAG_MAP = """# Map of a ROS bag

<!-- Written by `python -m sitegen.reference`. -->

A map gives the environment of a bag, its cars, and their topics. [ROS bags](../bags.md) shows how to use one. Unknown
keys are refused. `[[cars]]` is one table per car; `cars.name` is a key.

"""

TRAINING = """# Settings of a training

<!-- Written by `python -m sitegen.reference`. -->

Settings of `coopenv train` are a TOML file ([trainers](../trainers.md#coopenv-train)). Unknown keys are refused.
`[clone]` is optional: without it the policy starts at random.

"""


def topics() -> str:
    """Return the page of the topics of a car."""
    rows = []
    for role, (sender, rate, content) in TOPIC_ROWS.items():
        topic = SVEA.topics[role]
        age = "" if topic.max_age is None else f"{topic.max_age:g}"
        rows.append(
            (
                f"`{topic.name.removeprefix('fleet/').removeprefix('{car}/')}`",
                f"`{topic.type.replace('/msg/', '/')}`",
                sender,
                rate,
                age,
                content,
            )
        )
    found = table(("topic", "type", "from", "Hz", "max. age, s", "content"), rows)
    return f"{TOPIC}{found}\n\n{PROFILE}{_reference(CarProfile)}"


def _reference(part: type[Section]) -> str:
    """Return the table of the keys of a file, from the docstrings of its fields."""
    rows = [
        (f"`{key}`", _default(field), _values(field), " ".join(meaning.split())) for key, field, meaning in _keys(part)
    ]
    return table(("key", "default", "values", "meaning"), rows) + "\n"


def _keys(part: type[Section], prefix: str = "") -> Iterator[tuple[str, FieldInfo, str]]:
    """Yield the dotted keys of a section and of those in it, each with its field and its meaning."""
    meanings = part.meanings()
    for name, field in part.model_fields.items():
        if name in meanings and f"{prefix}{name}" not in ("file", "path"):
            yield f"{prefix}{name}", field, meanings[name]
        for kind in (field.annotation, *get_args(field.annotation)):
            if isinstance(kind, type) and issubclass(kind, Section) and kind is not CarProfile:
                yield from _keys(kind, f"{prefix}{name}.")


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value: Any = field.get_default(call_default_factory=True, validated_data={})
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float | int):
        return f"{value:.4g}" if isinstance(value, float) else str(value)
    if isinstance(value, BaseModel):
        return ""
    if isinstance(value, tuple):
        value = ", ".join(map(str, value))
    return f"`{value}`" if value else ""


def _values(field: FieldInfo) -> str:
    """Return the bounds of a number in words, or the values to choose from."""
    if get_origin(field.annotation) is Literal:
        return ", ".join(f"`{value}`" for value in get_args(field.annotation))
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    found = [(words[name], getattr(rule, name)) for rule in field.metadata for name in words if hasattr(rule, name)]
    return ", ".join(f"{word} {value:.4g}" for word, value in found if abs(value) < 1e6)


SCALES = {"targets": "number of targets", "steering": "angle at action 1", "pan": "angle at action 1"}
"""Scales that are no setting of `[observation]`."""
COLUMNS = ("field", "meaning", "unit", "scale", "center", "one per", "entries", "planar")


def observation() -> str:
    """Return the page that says what every entry of an observation and every term of the reward means."""
    parts = [OBSERVATION.strip()]
    parts += [", ".join(f"[`{name}`](../environments/{name}.md#observation)" for name in list_envs()) + "."]
    groups: dict[str, list[tuple[str, ...]]] = {}
    for name, field in OBSERVATION_FIELDS.built_in.items():
        planar = "" if field.planar is None else str(len(field.planar))
        scale = SCALES.get(str(field.scale), str(field.scale))
        row = (f"`{name}`", field.meaning, field.unit, scale, f"{field.center:.4g}", field.per, str(field.size), planar)
        groups.setdefault(field.group, []).append(row)
    for group, rows in groups.items():
        parts += [f"## {group}", table(COLUMNS, rows)]
    rewards = [
        (f"`{name}`", term.meaning + (" (uses the truth)" if term.privileged else ""), term.unit)
        for name, term in REWARD_TERMS.built_in.items()
    ]
    parts += ["## Terms of the reward", "`reward.weights.NAME` in a scenario weighs them; each counts per decision."]
    return "\n\n".join([*parts, table(("term", "meaning", "unit"), rewards)]) + "\n"


PAGES: dict[str, Callable[[], str]] = {
    "bag_map.md": lambda: BAG_MAP + _reference(TopicMap),
    "deployment.md": lambda: DEPLOYMENT + _reference(Deployment),
    "observation.md": observation,
    "topics.md": topics,
    "training.md": lambda: TRAINING + _reference(Settings),
}
"""Files in docs/reference, and their texts."""

if __name__ == "__main__":
    for name, page in PAGES.items():
        (ROOT / "docs" / "reference" / name).write_text(page(), encoding="utf-8")
