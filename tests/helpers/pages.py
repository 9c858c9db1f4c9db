"""Messages of the pages that play an episode."""

from __future__ import annotations

import base64
import re
from typing import Any

import pytest


def messages(page: str) -> tuple[float, list[tuple[float, dict[str, Any]]]]:
    """Return the length of the recording in a page, s, and its messages with their times."""
    msgspec = pytest.importorskip("msgspec", reason="needs the extra view")
    zstandard = pytest.importorskip("zstandard", reason="needs the extra view")
    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)
    assert found
    packed = base64.b64decode(found[1])
    inner = zstandard.ZstdDecompressor().decompress(packed[8:], max_output_size=int.from_bytes(packed[:8], "little"))
    length = int.from_bytes(inner[:8], "little")
    content = msgspec.msgpack.decode(inner[8 : 8 + length])
    return content["durationSeconds"], content["messages"]
