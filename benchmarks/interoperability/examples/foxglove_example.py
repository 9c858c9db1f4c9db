"""Foxglove: the reader of MCAP's documentation, on a log that `coopenv record` writes."""

# /// script
# dependencies = ["coopenv[log]", "mcap-protobuf-support>=0.5.3", "foxglove-schemas-protobuf>=0.4"]
# [tool.coopenv]
# package = "foxglove-sdk"
# documentation = "https://mcap.dev/guides/python/protobuf"
# ///

import subprocess
import sys
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

record = (Path(sys.executable).parent / "coopenv", "record", "busy_intersection", "--out", "drive.mcap")
subprocess.run(record, check=True, capture_output=True)
kinds: Counter[str] = Counter()
with Path("drive.mcap").open("rb") as file:
    reader = make_reader(file, decoder_factories=[DecoderFactory()])
    summary = reader.get_summary()
    shown = [c.topic for c in summary.channels.values() if summary.schemas[c.schema_id].encoding == "protobuf"]
    for schema, _channel, _message, decoded in reader.iter_decoded_messages(topics=shown):
        assert decoded.DESCRIPTOR.full_name == schema.name
        kinds[schema.name] += 1
print(f"{kinds.total():,} messages of {len(kinds)} of Foxglove's schemas read")
