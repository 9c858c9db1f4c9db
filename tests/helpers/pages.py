"""Messages of the pages that play an episode."""

from __future__ import annotations

import base64
import re
from typing import Any

import numpy as np
import pytest


def messages(page: str) -> tuple[float, list[tuple[float, dict[str, Any]]]]:
    """Return the length of the recording in a page, s, and its messages with their times."""
    msgspec = pytest.importorskip("msgspec", reason="needs the extra view")
    zstandard = pytest.importorskip("zstandard", reason="needs the extra view")
    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)
    assert found
    packed = base64.b64decode(found[1])
    inner = zstandard.ZstdDecompressor().decompress(packed[8:], max_output_size=int.from_bytes(packed[:8], "little"))
    end = 8 + int.from_bytes(inner[:8], "little")
    content = msgspec.msgpack.decode(inner[8:end])
    arrays = []
    for length in content["binaryBufferLengths"]:
        begin = -(-end // 8) * 8  # each array begins at a multiple of 8 bytes
        end = begin + length
        arrays.append(inner[begin:end])
    return content["durationSeconds"], _with_arrays(content["messages"], arrays)


def _with_arrays(value: Any, arrays: list[bytes]) -> Any:
    """Return messages with flat arrays in the places that refer to them."""
    if isinstance(value, list):
        return [_with_arrays(entry, arrays) for entry in value]
    if not isinstance(value, dict):
        return value
    if "__binary_index" in value:
        return np.frombuffer(arrays[value["__binary_index"]], value["dtype"])
    return {name: _with_arrays(entry, arrays) for name, entry in value.items()}
