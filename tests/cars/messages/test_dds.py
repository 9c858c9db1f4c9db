"""Bytes of messages beside those of DDS: CycloneDDS encodes and decodes samples of the same types by its own codec."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from coopenv.cars.messages import codec
from coopenv.cars.settings.profile import load_profile

pytest.importorskip("cyclonedds", reason="needs cyclonedds, which has no wheel for this platform")

from cyclonedds.idl import make_idl_struct, types
from rosbags.interfaces import Nodetype

NUMBERS = {name: getattr(types, name) for name in ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32")}
NUMBERS |= {"uint64": types.uint64, "float32": types.float32, "float64": types.float64, "bool": bool, "string": str}
KINDS = sorted({topic.type for name in ("svea", "diffdrive") for topic in load_profile(name).topics.values()})


@cache
def struct(kind: str) -> Any:
    """Return the type of DDS of a ROS 2 type."""
    package, _, name = kind.split("/")
    fields = {field: dds_type(node) for field, node in codec.ros2().fielddefs[kind][1]}
    return make_idl_struct(name, f"{package}::msg::dds_::{name}_", fields)


def dds_type(node: Any) -> Any:
    """Return the type of a field, which rosbags describes."""
    shape, of = node
    if shape.name == "BASE":
        return NUMBERS[of[0]]
    if shape.name == "NAME":
        return struct(of)
    return types.array[dds_type(of[0]), of[1]] if shape.name == "ARRAY" else types.sequence[dds_type(of[0])]


def draw(node: Any, rng: np.random.Generator) -> tuple[Any, Any]:
    """Return a random value of a field as this project and as DDS have it."""
    shape, of = node
    if shape.name == "NAME":
        pairs = {field: draw(inner, rng) for field, inner in codec.ros2().fielddefs[of][1]}
        ours, theirs = ({field: pair[k] for field, pair in pairs.items()} for k in (0, 1))
        return codec.make(of, **ours), struct(of)(**theirs)
    if shape.name == "BASE":
        if of[0] == "string":
            text = "".join(map(chr, rng.integers(97, 123, rng.integers(0, 9))))
            return text, text
        if of[0] == "bool":
            flag = bool(rng.integers(2))
            return flag, flag
        if of[0].startswith("float"):
            value = float(np.float32(rng.normal()))
        else:
            bounds = np.iinfo(of[0])
            value = int(rng.integers(bounds.min, bounds.max, dtype=of[0], endpoint=True))
        return value, value
    drawn = [draw(of[0], rng) for _ in range(of[1] if shape.name == "ARRAY" else int(rng.integers(4)))]
    ours, theirs = [a for a, _ in drawn], [b for _, b in drawn]
    return ours, theirs


def dds_bytes(sample: Any) -> bytes:
    """Return the CDR of a sample; padding at its end does not count."""
    return bytes(sample.serialize(use_version_2=False))


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_are_those_of_dds(kind: str) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        ours, theirs = draw((Nodetype.NAME, kind), rng)
        payload = codec.encode(ours)
        assert payload[4:] == dds_bytes(theirs)[4:]
        assert struct(kind).deserialize(payload) == theirs
        assert codec.encode(codec.decode(dds_bytes(theirs), kind)) == payload
