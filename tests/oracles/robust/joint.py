"""The same observer with larger messages: a vehicle tells its whole belief, up to `MAX_TOLD` vehicles and 2 kB.

What could reach a receiver by two ways is recognised: a sender whom another message speaks for adds nothing of its own.
So along a leader-follower graph no information is lost, and none counts twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array, cholesky
from coopenv.estimation.rotations import exp_so3, log_so3
from coopenv.observers.contract import Message, Tick
from coopenv.observers.robust.constants import (
    DEPENDENT_SHARE,
    MAX_MEMBERS_JOINT,
    MAX_TOLD,
    NEWS_TIME,
    SAME_TIME,
    SUPERSEDING_TIME,
)
from tests.oracles.robust.belief import Member, errors_of
from tests.oracles.robust.common import Common, Contact
from tests.oracles.robust.eviction import room_for
from tests.oracles.robust.tracklets import Report, from_message, marker_jacobian, mask_of, tracklet


class RobustJoint(Common):
    """One vehicle's observer; messages hold a joint belief: 281 bytes alone, 1715 with three others."""

    most_members = MAX_MEMBERS_JOINT

    def message(self) -> Message:
        """Return the belief about oneself and as many others as fit, or nothing while the pose is not known."""
        message = super().message()
        if message.position is None:
            return message
        places = [n for n, member in enumerate(self.belief.members) if member.vehicle >= 0]
        told, index = [self.belief.members[n] for n in places[:MAX_TOLD]], errors_of(places[:MAX_TOLD])
        P = self.belief.P[np.ix_(index, index)]
        if self.marker.any():
            J = np.eye(len(P))
            J[:6, :6] = marker_jacobian(self.marker)
            P = J.dot(P).dot(J.T)
        return replace(
            message,
            extra={**message.extra, **_told(told, P, len(told) == len(places), self.belief.own.time)},
        )

    @staticmethod
    def tampered(message: Message) -> Message:
        """Return a message whose joint belief claims what its covariance does, for studies of liars."""
        if message.covariance is None or "factor" not in message.extra:
            return message
        P = _joint_covariance(message)
        P[:6, 6:], P[6:, :6], P[:6, :6] = 0.0, 0.0, message.covariance
        return replace(message, extra={**message.extra, "factor": _factor(P)})

    def _report(self, message: Message, sender: int, time: float) -> Report | None:
        """Return what a message says of its sender and, unless it leans on this vehicle, of the others it tells of."""
        report = from_message(message, sender, time)
        if report is None or report.depends_on_vehicle(self.vehicle):
            return report
        return _with_others(report, message)

    def _is_spoken_for(self, report: Report, taken: list[Report]) -> bool:
        """Return whether a report that was taken in says all that this one does."""
        return any(_speaks_for(other, report) for other in taken)

    def _listen(self, tick: Tick) -> None:
        """Take in the messages of those in view, and of those that are already believed in."""
        in_view = {target - self.landmarks for target in tick.targets[tick.valid].tolist()}
        reports = sorted(self._reports(tick), key=lambda report: -len(report.vehicles))
        self._notice(in_view, reports, tick.time)
        heard = {report.vehicles[0] for report in reports}
        taken = [contact.last for sender, contact in self.contacts.items() if sender not in heard]
        for report in reports:
            contact = self.contacts.get(report.vehicles[0])
            if self._is_spoken_for(report, taken):
                if contact is not None:
                    contact.last = report
                continue
            if contact is not None and contact.last.vehicles == report.vehicles:
                self._hear(contact, report)
            elif contact is not None or not in_view.isdisjoint(report.vehicles):
                self._meet(report, tick.time)
            if (contact := self.contacts.get(report.vehicles[0])) is not None:
                taken.append(contact.last)
        self._forget_contacts()

    def _meet(self, report: Report, time: float) -> None:
        """Take in a sender that is new, or tells of other vehicles than before, if there is room."""
        told = set(report.vehicles) - {self.vehicle}
        forgotten = room_for(self.belief, told, self.most_members, time)
        if forgotten is None:
            return
        self.belief.drop(told | forgotten)
        numbers = [n for n, v in enumerate(report.vehicles) if v in told]
        index = errors_of(numbers)
        odometry = zip(report.odometry_turn, report.odometry_position, strict=True)
        poses = list(zip(report.vehicles, report.R, report.p, report.time.tolist(), odometry, strict=True))
        self.belief.add([Member(*poses[n], seen=time) for n in numbers], report.P[np.ix_(index, index)])
        self.contacts[report.vehicles[0]] = Contact(report)
        self._forget_contacts()
        self.depends_on |= report.depends_on | int(mask_of(told))

    def _forget_contacts(self) -> None:
        """Forget the senders that tell of vehicles which are not members; they may be met again."""
        members = {member.vehicle for member in self.belief.members}
        self.contacts = {
            v: contact for v, contact in self.contacts.items() if members.issuperset(contact.last.vehicles)
        }

    def _hear(self, contact: Contact, report: Report) -> None:
        """Carry a sender to its new message, and take in what it has learnt since the last one."""
        last = contact.last
        dt = float(report.time[0] - last.time[0])
        if dt <= NEWS_TIME - SAME_TIME:  # of the same message again, or of one soon after, the odometry counts at most
            return
        contact.last = report
        members = [member.vehicle for member in self.belief.members]
        places = [members.index(v) for v in report.vehicles]
        for n, R, p, time in zip(
            places, report.odometry_turn, report.odometry_position, report.time.tolist(), strict=True
        ):
            if n > 0:
                self.belief.follow(n, R, p, time, self.noise)
        was_trusted = contact.trusted
        self._judge(contact, report, dt)
        learnt = (
            tracklet(last, report, self.noise, self.belief.errors_covariance)
            if was_trusted and contact.trusted
            else None
        )
        if learnt is None:
            return
        share = self._share(report)
        information, vector = learnt.about([self.belief.members[n] for n in places])
        self.belief.inform(errors_of(places), share * information, share * vector)
        self.depends_on |= report.depends_on

    def _share(self, report: Report) -> float:
        """Return how much of a sender's news counts.

        All if it depends on nobody, `DEPENDENT_SHARE` if on others. Where senders depend on this vehicle in turn, each
        of n counts 1 / (n + 1): then what comes back round any loop fades, however dense the graph is.
        """
        if not report.depends_on:
            return 1.0
        if not report.depends_on_vehicle(self.vehicle):
            return DEPENDENT_SHARE
        return 1.0 / (1.0 + sum(contact.last.depends_on_vehicle(self.vehicle) for contact in self.contacts.values()))


def _speaks_for(other: Report, report: Report) -> bool:
    """Return whether another report says all that this one does."""
    sender = report.vehicles[0]
    if (
        sender == other.vehicles[0]
        or sender not in other.vehicles
        or report.time[0] - other.time[0] > SUPERSEDING_TIME + SAME_TIME
    ):
        return False
    return len(other.vehicles) > len(report.vehicles) or other.vehicles[0] < sender


def _told(told: list[Member], P: Array, complete: bool, time: float) -> dict[str, Array]:
    """Return the others' poses and odometry, and the factor of the joint covariance P (6m, 6m), as they travel."""
    others = told[1:]
    odometry = [member.odometry for member in others if member.odometry is not None]
    return {
        "vehicles": np.array([member.vehicle for member in others], dtype=np.uint16),
        "ages": time - np.array([member.time for member in others]),
        "poses": _six([(member.R, member.p) for member in others]),
        "odometries": _six(odometry),
        "factor": _factor(P),
        "complete": np.array([complete], dtype=np.uint8),
    }


def _six(poses: Sequence[tuple[Array, Array]]) -> Array:
    """Return poses as rotation vectors and positions (m, 6)."""
    return np.array([np.concatenate([log_so3(R), p]) for R, p in poses]).reshape(-1, 6)


@cache
def _triangle(n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where the lower triangle of an n by n matrix is."""
    return np.tril_indices(n)


def _with_others(report: Report, message: Message) -> Report:
    """Return a report with all that the message tells."""
    if "factor" not in message.extra:
        return report
    told = message.extra
    poses, odometries = told["poses"], told["odometries"]
    return Report(
        vehicles=(*report.vehicles, *(int(v) for v in told["vehicles"])),
        time=np.concatenate([report.time, report.time[0] - told["ages"]]),
        R=np.array([report.R[0], *(exp_so3(pose[:3]) for pose in poses)]),
        p=np.concatenate([report.p, poses[:, 3:]]),
        odometry_turn=np.array([report.odometry_turn[0], *(exp_so3(o[:3]) for o in odometries)]),
        odometry_position=np.concatenate([report.odometry_position, odometries[:, 3:]]),
        P=_joint_covariance(message),
        depends_on=0 if told["complete"][0] else report.depends_on,
    )


def _factor(P: Array) -> Array:
    """Return the Cholesky factor of a joint covariance (6m, 6m), row by row.

    In single precision it keeps what a covariance would lose.
    """
    return cholesky(P)[_triangle(len(P))].astype(np.float32)


def _joint_covariance(message: Message) -> Array:
    """Return the joint covariance (6m, 6m) of a message that holds its factor."""
    n = 6 * (1 + len(message.extra["vehicles"]))
    L = np.zeros((n, n))
    L[_triangle(n)] = message.extra["factor"]
    result: Array = L.dot(L.T)
    return result
