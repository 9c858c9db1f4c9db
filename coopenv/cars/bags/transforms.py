"""Transforms of a bag (`/tf`, `/tf_static`): poses of bodies through the static tree, and the mounting of cameras."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, listed, printable
from coopenv.cars.bags.files import BagFile
from coopenv.cars.bags.topic_map import Chosen, TopicMap
from coopenv.cars.messages.readings import OTHER_FIELDS, CarPose, placed
from coopenv.cars.settings.profile import TRANSFORMS, Role
from coopenv.estimation.poses import orientation_error_deg
from coopenv.scenario.sensing import Camera

FIRST = 500
"""Messages with transforms that are looked at for the tree and for notes."""
DEEPEST = 64  # frames in a branch of the tree
BASE = "base_link"
TURNED, SHIFTED = 2.0, 0.05
"""Difference of a camera's mounting from the environment's that is worth a line, deg and m."""

MALFORMED = (CoopenvError, *OTHER_FIELDS)

ROOT = CarPose(np.zeros(3), np.eye(3))


def frame_name(text: str) -> str:
    """Return the name of a frame without the slash that ROS 1 has before it."""
    return str(text).removeprefix("/")


def composed(outer: CarPose, inner: CarPose) -> CarPose:
    """Return the pose of a body in the outer frame by its pose in the inner one."""
    assert outer.rotation is not None and inner.rotation is not None
    return CarPose(outer.position + outer.rotation @ inner.position, outer.rotation @ inner.rotation)


@dataclass
class StaticTree:
    """The static transforms of a bag."""

    parents: dict[str, tuple[str, CarPose]] = field(default_factory=dict)
    """By frame its parent and the pose in that."""

    @classmethod
    def of(cls, files: Sequence[BagFile]) -> "StaticTree":
        """Return the tree of all topics called tf_static; malformed transforms are left out."""
        tree = cls()
        for _, parent, child, transform in transforms_of(files, static=True):
            with suppress(*MALFORMED):
                tree.parents.setdefault(frame_name(child), (frame_name(parent), placed(transform)))
        return tree

    def up(self, frame: str, until: Collection[str] = ()) -> tuple[str, CarPose]:
        """Return the uppermost frame above one through static transforms, or one of some; and the pose in that."""
        pose = ROOT
        for _ in range(DEEPEST):
            if frame not in self.parents or frame in until:
                break
            frame, inner = self.parents[frame]
            pose = composed(inner, pose)
        return frame, pose

    def body_at(self, message: Any, body: str) -> tuple[Any, CarPose] | None:
        """Return the transform of a message that moves a body, and the body's pose in the root; None: there is none."""
        carrier, mounted = self.up(body)
        for part in message.transforms:
            if frame_name(part.child_frame_id) == carrier:
                _, above = self.up(frame_name(part.header.frame_id))
                return part, composed(composed(above, placed(part.transform)), mounted)
        return None


def transforms_of(files: Sequence[BagFile], static: bool) -> Iterator[tuple[str, str, str, Any]]:
    """Yield topic, parent, child and Transform of the first messages with static transforms, or with others."""
    for file in files:
        kinds = [name for name, kind in file.topics.items() if kind in TRANSFORMS]
        names = [name for name in kinds if (name.rpartition("/")[2] == "tf_static") == static]
        for topic, _, decode in islice(file.messages(names), FIRST) if names else ():
            with suppress(*MALFORMED):
                for part in decode().transforms:
                    yield topic, str(part.header.frame_id), str(part.child_frame_id), part.transform


def unread_truth(files: Sequence[BagFile], given: TopicMap, chosen: Sequence[Chosen]) -> Iterator[str]:
    """Yield a note on the poses that transforms have, of cars of which there is no motion capture."""
    known = {entry.car for entry in chosen if entry.role is Role.TRUTH}
    bodies = {car.names["body"] for car in given.cars if car.name not in known}
    found: dict[str, str] = {}
    for topic, parent, child, _ in transforms_of(files, static=False) if bodies else ():
        if any(body in child.split("/") for body in bodies):
            found.setdefault(child, f"{topic}: {parent} -> {child}")
    if found:
        poses = printable(listed(sorted(found.values())))
        yield f"poses in transforms are not read as motion capture: {poses}; `truth` and `body` name topic and frame"


def odd_mountings(
    tree: StaticTree, frames: Mapping[str, str], bodies: Mapping[str, str], cameras: Mapping[str, Camera]
) -> Iterator[str]:
    """Yield a note for each camera whose mounting in the tree is not that of the environment.

    Args:
        tree: of the bag.
        frames: optical frame of each car's camera, as its messages name it.
        bodies: frame of each car's body, if that is not `base_link`.
        cameras: the environment's cameras by car.
    """
    for car, name in frames.items():
        root, mounted = tree.up(frame_name(name), (BASE, bodies[car]))
        if root == frame_name(name) or mounted.rotation is None:
            continue
        turned = float(orientation_error_deg(mounted.rotation, cameras[car].to_body()))
        shifted = float(np.linalg.norm(mounted.position - np.array(cameras[car].position)))
        if turned > TURNED or shifted > SHIFTED:
            place = ", ".join(f"{value:.3g}" for value in mounted.position)
            off = f"{turned:.2g} deg and {shifted:.2g} m off the camera of the environment, which counts"
            yield f"camera of {car}: transforms mount it at [{place}] of {printable(root)}, {off}"
