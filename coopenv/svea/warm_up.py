"""Compile the codecs before time matters: the first message of a type takes a tenth of a second."""

from functools import cache
from typing import Any

import numpy as np

from coopenv.svea.codec import ros2
from coopenv.svea.topics import TOPICS


@cache
def warm_up() -> None:
    """Encode and decode one message of every type."""
    store = ros2()
    for topic in TOPICS.values():
        message = empty(topic.type)
        store.deserialize_cdr(store.serialize_cdr(message, topic.type), topic.type)


def empty(kind: str) -> Any:
    """Return a ROS 2 message of a type whose fields are zero and empty."""
    store = ros2()
    return store.types[kind](**{name: _value(node) for name, node in store.fielddefs[kind][1]})


def _value(node: Any) -> Any:
    """Return the zero of a field, as rosbags describes it."""
    kind, of = node
    if kind.name == "NAME":
        return empty(of)
    if kind.name == "BASE":
        return "" if of[0] == "string" else np.zeros(1, dtype=of[0])[0].item()
    element, length = of[0], of[1] if kind.name == "ARRAY" else 0
    if element[0].name == "BASE" and element[1][0] != "string":
        return np.zeros(length, dtype=element[1][0])
    return [_value(element) for _ in range(length)]
