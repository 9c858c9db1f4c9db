"""Tables of the reference, made from docstrings when the site is built."""

import re
from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from coopenv.base.installation import list_envs
from coopenv.base.sections import Section
from coopenv.bench.observers.rows import Row
from coopenv.cars.bags.topic_map import TopicMap
from coopenv.cars.settings.deployment import Deployment
from coopenv.cars.settings.profile import SVEA, CarProfile, Role
from coopenv.report.table import markdown
from coopenv.scenario.terms import OBSERVATION_FIELDS, REWARD_TERMS
from coopenv.training.settings import Settings

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


def topics() -> str:
    """Return the table of the topics of a car."""
    rows = []
    for role, (sender, rate, content) in TOPIC_ROWS.items():
        topic = SVEA.topics[role]
        name, kind = topic.name.removeprefix("fleet/").removeprefix("{car}/"), topic.type.replace("/msg/", "/")
        age = "" if topic.max_age is None else f"{topic.max_age:g}"
        rows.append((f"`{name}`", f"`{kind}`", sender, rate, age, content))
    return markdown(("topic", "type", "from", "Hz", "max. age, s", "content"), rows)


def _reference(part: type[Section]) -> str:
    """Return the table of the keys of a file, from the docstrings of its fields."""
    rows = [
        (f"`{key}`", _default(field), _values(field), " ".join(meaning.split())) for key, field, meaning in _keys(part)
    ]
    return markdown(("key", "default", "values", "meaning"), rows)


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


SCALES = {
    "targets": "number of targets",
    **dict.fromkeys(("steering", "turn_rate", "lateral_speed", "pan"), "value at action 1"),
}
"""Scales that are no setting of `[observation]`."""
COLUMNS = ("field", "meaning", "unit", "scale", "center", "one per", "entries", "planar")


def observation() -> str:
    """Return what every entry of an observation and every term of the reward means."""
    parts = [", ".join(f"[`{name}`](../environments/{name}.md#observation)" for name in list_envs()) + "."]
    groups: dict[str, list[tuple[str, ...]]] = {}
    for name, field in OBSERVATION_FIELDS.built_in.items():
        planar = "" if field.planar is None else str(len(field.planar))
        scale = SCALES.get(str(field.scale), str(field.scale))
        row = (f"`{name}`", field.meaning, field.unit, scale, f"{field.center:.4g}", field.per, str(field.size), planar)
        groups.setdefault(field.group, []).append(row)
    for group, rows in groups.items():
        parts += [f"## {group}", markdown(COLUMNS, rows)]
    rewards = [
        (f"`{name}`", term.meaning + (" (uses the truth)" if term.privileged else ""), term.unit)
        for name, term in REWARD_TERMS.built_in.items()
    ]
    parts += ["## Terms of the reward", "`reward.weights.NAME` in a scenario weighs them; each counts per decision."]
    return "\n\n".join([*parts, markdown(("term", "meaning", "unit"), rewards)])


def comparison() -> str:
    """Return the columns of a comparison of observers, which its report explains in the same words."""
    return markdown(("column", "meaning"), [(f"`{column.name}`", column.metadata["meaning"]) for column in fields(Row)])


TABLES: dict[str, Callable[[], str]] = {
    "bag_map": lambda: _reference(TopicMap),
    "comparison": comparison,
    "deployment": lambda: _reference(Deployment),
    "observation": observation,
    "profile": lambda: _reference(CarProfile),
    "topics": topics,
    "training": lambda: _reference(Settings),
}
_PLACE = re.compile(r"<!-- table: (\w+) -->\n.*?(?=\n\n|\Z)", re.DOTALL)


def filled(text: str) -> str:
    """Return a page with its tables, each instead of the paragraph behind a comment that names it."""
    return _PLACE.sub(lambda place: TABLES[place[1]](), text)
