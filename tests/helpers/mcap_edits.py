"""Recordings in MCAP files rewritten with other contents and valid check sums, as whoever means harm writes them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from coopenv.sources.mcap_format import ATTACHMENT


class Sent(NamedTuple):
    """One message."""

    topic: str
    tick: int
    data: bytes


def edit(
    source: Path,
    target: Path,
    *,
    header: Callable[[dict[str, Any]], Any] = lambda facts: facts,
    messages: Callable[[Sent], Iterable[Sent]] = lambda sent: [sent],
    encoding: str = "cdr",
    schema_name: Callable[[str], str] = lambda name: name,
    schema_encoding: str = "ros2msg",
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Copy a recording, its header (`recording.json`), messages and descriptions of channels changed on the way."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with source.open("rb") as stream, target.open("wb") as output:
        reader = make_reader(stream)
        about = next(reader.iter_metadata()).metadata
        facts = json.loads(next(reader.iter_attachments()).data)
        changed = header(facts)
        text = changed if isinstance(changed, bytes) else json.dumps(changed).encode()
        writer = Writer(output)
        writer.start(profile="ros2")
        writer.add_metadata("coopenv", {**about, "sha256": hashlib.sha256(text).hexdigest(), **(metadata or {})})
        writer.add_attachment(0, 0, ATTACHMENT, "application/json", text)
        channels: dict[str, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            for sent in messages(Sent(channel.topic, message.sequence, message.data)):
                if sent.topic not in channels:
                    known = writer.register_schema(schema_name(schema.name), schema_encoding, schema.data)
                    channels[sent.topic] = writer.register_channel(sent.topic, encoding, known)
                writer.add_message(channels[sent.topic], message.log_time, sent.data, message.log_time, sent.tick)
        writer.finish()
