"""rosbags: `AnyReader` of its documentation, on a bag that `coopenv record --ros` writes."""

# /// script
# dependencies = ["coopenv[log]", "rosbags>=0.11.9"]
# [tool.coopenv]
# package = "rosbags"
# documentation = "https://ternaris.gitlab.io/rosbags/topics/highlevel.html"
# ///

import subprocess
import sys
from collections import Counter
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

coopenv = Path(sys.executable).parent / "coopenv"
subprocess.run(
    (coopenv, "record", "svea_crossing", "--ros", "--out", "drive", "--force"), check=True, capture_output=True
)
bag = next(path.parent for path in Path("drive").rglob("metadata.yaml"))
messages: Counter[str] = Counter()
with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
    for connection, _time, data in reader.messages():
        reader.deserialize(data, connection.msgtype)
        messages[connection.msgtype] += 1
print(f"{messages.total():,} messages of {len(messages)} types read")
