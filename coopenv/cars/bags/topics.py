"""The topics of bags: what an unknown bag holds, and the map that is proposed for it."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from coopenv.base.errors import CoopenvError, printable
from coopenv.cars.backend.assembler import BROADCAST
from coopenv.cars.bags.clocks import checked
from coopenv.cars.bags.files import BagFile
from coopenv.cars.bags.topic_map import READ
from coopenv.cars.messages.readings import POSES, READERS, UNSTAMPED, read
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import IMAGES, SVEA, VELOCITY, Role
from coopenv.cars.settings.sensors import TOPIC

NS = 1_000_000_000


@dataclass(frozen=True)
class TopicRow:
    """A topic; unknown values are None."""

    topic: str
    type: str
    messages: int
    rate: float | None  # Hz
    car: str | None = None  # that it was read for
    role: str | None = None
    used: int | None = None  # messages
    gap: float | None = None  # s, the longest between two
    gaps: int | None = None  # pauses of more than three times the usual period
    offset: float | None = None  # s by which its stamps are behind the recorder's clock, transport included
    outlying: int | None = None  # messages that were dropped for their stamps
    lead: float | None = None  # s by which its stamps are early, by what it measures
    lead_error: float | None = None  # s, standard error
    reference: str | None = None  # reference of their lead


def regularity(stamps: np.ndarray) -> tuple[float | None, float | None, int | None]:
    """Return the rate in Hz, the longest gap in s and the number of gaps over three median periods of stamps in ns."""
    steps = np.diff(stamps) * 1e-9
    if not len(steps) or steps.sum() <= 0.0:
        return None, None, None
    return float(len(steps) / steps.sum()), float(steps.max()), int((steps > 3.0 * np.median(steps)).sum())


CAPTURE = re.compile(r"qualisys|mocap|vicon|optitrack|vrpn|truth|ground", re.IGNORECASE)
"""Pattern in names of topics of motion capture."""
COMMANDED = re.compile(r"cmd|command|setpoint|target", re.IGNORECASE)
"""Pattern in names of topics of commands, whose types are those of measured twists."""
ANY_CAMERA = Calibration((100_000, 100_000), (1e5, 1e5), (5e4, 5e4), (0.0,) * 5)
"""Intrinsics for which every detection is inside the image."""
TO_WHEELS = (SVEA.topics[Role.MANUAL].type,)
DRIFTING = 1e-5  # s per s from which a clock's drift is mentioned


def examined(files: Sequence[BagFile]) -> tuple[tuple[TopicRow, ...], tuple[str, ...]]:
    """Return a row per topic, and what is wrong with stamps, a line each."""
    times = [file.times() for file in files]
    rows, notes = [], list[str]()
    for name in sorted({name for found in times for name in found}):
        kind = next(file.topics[name] for file in files if name in file.topics)
        parts = [found[name] for found in times if name in found]
        received = np.sort(np.concatenate([received for _, received in parts]))
        rate, gap, gaps = regularity(received)
        wrong, offset = 0, None
        for stamps, arrived in parts:
            bad, delay = checked(stamps, arrived)
            if delay is None:
                continue
            wrong, offset = wrong + int(bad.sum()), delay.offset / NS
            if not stamps.all():
                notes.append(f"{name}: {int((stamps == 0).sum())} of {len(stamps)} stamps are 0")
            if abs(delay.drift) > DRIFTING:
                notes.append(f"{name}: its clock drifts by {1e6 * delay.drift:+.0f} us per s")
            if delay.jump:
                notes.append(f"{name}: its clock jumps by {delay.jump / NS:.2g} s")
        if wrong:
            notes.append(f"{name}: {wrong} of {len(received)} stamps are wrong, and will be left out")
        rows.append(TopicRow(name, kind, len(received), rate, gap=gap, gaps=gaps, offset=offset, outlying=wrong))
    return tuple(rows), tuple(notes)


def proposed(files: Sequence[BagFile], rows: Sequence[TopicRow]) -> str:
    """Return a map of bags with such topics, as TOML text. Raises CoopenvError: no topic has detections of a camera."""
    cars = cars_of(rows)
    used = {name for topics in cars.values() for name in topics.values()}
    markers = ", ".join(f"{number} ({count} frames)" for number, count in sorted(markers_of(files, used).items()))
    none = "images ([vision]: their tags)" if any(r.type in IMAGES and r.topic in used for r in rows) else "no marker"
    lines = [
        "# Proposed by names and types of topics: check every line.",
        'environment = "my_environment.toml" # landmarks, camera, noise: a name (coopenv list), or a file beside this',
        'names = "none"',
        f"# The camera has seen {markers or none}.",
        "markers = {} # numbers by name of the landmark: { SL1 = 1 }",
    ]
    for car, topics in cars.items():
        lines += ["", "[[cars]]", f'name = "{car}"', "# marker = 7 # its own, seen by other cars"]
        lines += ['# vehicle = "vehicle_1" # of the environment (default: in the order of this file)', "[cars.topics]"]
        lines += [f'{role.value} = "{name}"' for role, name in topics.items()]
    kinds = [row for row in rows if row.topic not in used]
    lines += ["", "# Not used:", *(printable(f"#   {row.topic} ({row.type})") for row in kinds)] if kinds else []
    return "\n".join(lines) + "\n"


def cars_of(rows: Sequence[TopicRow]) -> dict[str, dict[Role, str]]:
    """Return the topics by role of every car with a camera, by the part of the names that differs between cars."""
    roles = {row.topic: role for row in rows if (role := role_of(row)) is not None}
    cameras = next((t for r in (Role.DETECTIONS, Role.BEARINGS) if (t := [n for n in roles if roles[n] is r])), [])
    if not cameras:
        kinds = ", ".join(kind for role in (Role.DETECTIONS, Role.BEARINGS) for kind in READERS[role])
        raise CoopenvError(f"no map can be proposed: no topic has detections of a camera ({kinds})")
    found: dict[str, dict[Role, str]] = {}
    for car, names in _owned(cameras, roles):
        best = sorted((row for row in rows if row.topic in names), key=lambda row: row.messages)
        by_role = {roles[row.topic]: row.topic for row in best}
        found[car] = {role: by_role[role] for role in READ if role in by_role and role not in BROADCAST}
    return found


def _owned(cameras: Sequence[str], roles: Mapping[str, Role]) -> Iterator[tuple[str, set[str]]]:
    """Yield cars and their topics: those that have the name of the car as a part."""
    parts = [camera.split("/") for camera in cameras]
    if len(cameras) > 1:
        place = next(k for k in range(max(map(len, parts))) if len({tuple(p[k : k + 1]) for p in parts}) > 1)
        for own in parts:
            yield _name(own[place]), {name for name in roles if own[place] in name.split("/")}
        return
    moving = [name.split("/") for name, role in roles.items() if any(role in some for some in VELOCITY.values())]
    shared = [part for k, part in enumerate(parts[0]) if any(other[: k + 1] == parts[0][: k + 1] for other in moving)]
    yield _name(shared[-1] if shared else ""), set(roles)


def _name(part: str) -> str:
    """Return a name of a car."""
    text = re.sub(r"\W", "_", part)
    return text if text[:1].isalpha() else f"car_{text}".rstrip("_")


def role_of(row: TopicRow) -> Role | None:
    """Return the role of a topic by its type, and by its name where that leaves several."""
    if COMMANDED.search(row.topic) or not re.match(TOPIC, row.topic) or row.type in UNSTAMPED:
        return None
    if row.type in POSES and CAPTURE.search(row.topic):
        return Role.TRUTH
    order = (Role.ODOMETRY, *READ) if row.type == "nav_msgs/msg/Odometry" else (Role.WHEEL, *READ)
    return next((role for role in order if role in READ and row.type in READERS.get(role, TO_WHEELS)), None)


def markers_of(files: Sequence[BagFile], used: set[str]) -> Counter[int]:
    """Return in how many frames each marker was detected on the topics that are used. Images are not searched."""
    found: Counter[int] = Counter()
    for file in files:
        for role in (Role.DETECTIONS, Role.BEARINGS):
            kinds = READERS[role].keys() - IMAGES
            for _, _, decode in file.messages([name for name in used if file.topics.get(name) in kinds]):
                with suppress(CoopenvError):
                    found.update(getattr(read(role, decode(), ANY_CAMERA), "markers", ()))
    return found
