"""The observer of this project's own: consistent, hard to mislead, and at home from any start.

One vehicle keeps a joint belief about itself and the vehicles that it hears. Bearings, to landmarks and to vehicles,
correct it in the vehicle's own pose; the others stand where they say that they are, their errors being considered
(told.py). So nothing that was heard before counts twice, and a neighbour's slowly varying error is no white noise.

- Start and loss: with no useful prior, or when most bearings contradict the belief, the pose is searched for among all
  P3P solutions (search.py). Meanwhile the vehicle says nothing.
- Wrong associations: a bearing counts if it fits (chi-square gate on the innovation) and its target is ahead.
- Liars: a message that contradicts the belief about its sender is not used; the sender is then tracked by its own
  odometry and by bearings, until its messages have agreed for a while.
- Loss and delay: a sender stands in the belief where its last message put it, and is carried on by its last twist.
- Many neighbours: where there is no room for one in view, those that have been out of view for longest make room.
- Rumours: senders tell how their errors correlate with those of the vehicles that they hear.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Message, Setup, Tick
from coopenv.observers.robust.constants import (
    LEAST_FORGIVEN,
    LEAST_NEWS,
    MAX_CORRELATIONS,
    MAX_TOLD_VARIANCE,
    NEWS_TIME,
    SAME_TIME,
    STEP_GATE,
    STEPS,
)
from tests.oracles.robust.belief import ERRORS, Member, recentring
from tests.oracles.robust.common import Common, Contact
from tests.oracles.robust.eviction import room_for
from tests.oracles.robust.told import Correlations, factor, is_positive, is_same, regress
from tests.oracles.robust.tracklets import Report, left_error, marker_jacobian, mask_of


class Robust(Common):
    """One vehicle's observer; messages hold pose and covariance (172 bytes), at times correlations (256 bytes)."""

    def __init__(self, setup: Setup) -> None:
        """Take what the vehicle knows before it starts."""
        super().__init__(setup)
        self.correlations = Correlations()
        self.interval = -1

    def message(self) -> Message:
        """Return pose, covariance, odometry and the correlations with members."""
        message = super().message()
        if message.position is None:
            return message
        extra = {"odometry": message.extra["odometry"].astype(np.float32)}
        interval = int(np.floor((self.belief.own.time + SAME_TIME) / NEWS_TIME))
        if interval != self.interval:
            self.interval = interval
            extra |= self._correlations()
        return replace(message, extra={**message.extra, **extra})

    def _correlations(self) -> dict[str, Array]:
        """Return the correlations with some members, as they travel."""
        P, J = self.belief.P, marker_jacobian(self.marker)
        A = factor(J.dot(P[:6, :6]).dot(J.T))
        told = self._told_of()
        correlations = np.zeros((len(told), 6, 6), np.int8)
        for k, n in enumerate(told):
            block = slice(6 * n, 6 * n + 6)
            C = np.linalg.solve(A, np.linalg.solve(factor(P[block, block]), J.dot(P[:6, block]).T).T)
            correlations[k] = np.clip(np.rint(STEPS * C), -STEPS, STEPS)
        members = [self.belief.members[n] for n in told]
        return {
            "told": np.array([member.vehicle for member in members], np.uint16),
            "ages": np.array([self.belief.own.time - member.time for member in members], np.float32),
            "correlations": correlations,
        }

    def _told_of(self) -> list[int]:
        """Return which members are told of: those that depend on most others, to whom there are most ways."""
        members = [n for n, m in enumerate(self.belief.members) if n and m.vehicle != ERRORS and m.considered]

        def order(n: int) -> tuple[int, int]:
            vehicle = self.belief.members[n].vehicle
            return self.contacts[vehicle].last.depends_on.bit_count(), vehicle

        return sorted(members, key=order, reverse=True)[:MAX_CORRELATIONS]

    def _listen(self, tick: Tick) -> None:
        """Take in the messages of members that count, and those of others in view, leaders first."""
        in_view = {target - self.landmarks for target in tick.targets[tick.valid].tolist()}
        for target, received in tick.messages.items():
            self.correlations.hear(target - self.landmarks, received.message, tick.time - received.age)
        reports = {report.vehicles[0]: report for report in self._reports(tick)}
        self._notice(in_view, list(reports.values()), tick.time)
        news = {s: r for s, r in reports.items() if "told" in tick.messages[s + self.landmarks].message.extra}
        last = {sender: float(contact.last.time[0]) + SAME_TIME for sender, contact in self.contacts.items()}
        pending = {s: r for s, r in news.items() if s in last and r.time[0] > last[s]}
        while pending:
            s = min(pending, key=lambda s: (self._has_to_wait(s, pending), *_rank(pending[s])))
            self._hear(self.contacts[s], pending.pop(s))
        for report in sorted(reports.values(), key=_rank):
            if report.vehicles[0] in in_view and report.vehicles[0] not in self.contacts:
                self._meet(report, tick.time)

    def _has_to_wait(self, sender: int, pending: dict[int, Report]) -> bool:
        """Return whether a report has to wait for another one, so that all fit what is told of them.

        It has to where it tells of another member's report that is not taken yet, and where another one's that is not
        taken tells of the sender's report before.
        """
        for other in pending:
            if other != sender:
                told, theirs = self.correlations.of(sender, other), self.correlations.of(other, sender)
                last = self.contacts[other].last.time[0]
                if told is not None and told.time > last and not is_same(told.time, last):
                    return True
                if theirs is not None and is_same(theirs.time, self.contacts[sender].last.time[0]):
                    return True
        return False

    def _meet(self, report: Report, time: float) -> None:
        """Take in a sender that is new, if there is room."""
        told = set(report.vehicles)
        forgotten = room_for(self.belief, told, self.most_members, time)
        if forgotten is None:
            return
        self.belief.drop(told | forgotten)
        odometry = report.odometry_turn[0], report.odometry_position[0]
        member = Member(report.vehicles[0], report.R[0], report.p[0], float(report.time[0]), odometry, seen=time)
        member.considered = True
        self.belief.add([member], report.P)
        self.contacts[report.vehicles[0]] = Contact(report)
        self.contacts = {v: c for v, c in self.contacts.items() if v not in forgotten}
        self._relate(len(self.belief.members) - 1, report)
        self.depends_on |= report.depends_on | int(mask_of(told))

    def _relate(self, n: int, report: Report) -> None:
        """Let the error of a sender that has just been met depend on those of the others as told."""
        crosses = self.correlations.crosses(self.belief, n, report.P, True)
        row, _ = regress(self.belief.P, n, report.P, crosses, False, self._least(report))
        block = slice(6 * n, 6 * n + 6)
        self.belief.P[block], self.belief.P[:, block] = row, row.T

    def _hear(self, contact: Contact, report: Report) -> None:
        """Put a sender where it says that it is, and let one's own pose follow what it has learnt."""
        last = contact.last
        dt = float(report.time[0] - last.time[0])
        contact.last = report
        belief, n = self.belief, self.belief.place(report.vehicles[0])
        assert n is not None
        belief.follow(n, report.odometry_turn[0], report.odometry_position[0], float(report.time[0]), self.noise)
        was_trusted = contact.trusted
        self._judge(contact, report, dt)
        member = belief.members[n]
        member.considered = contact.trusted
        if not contact.trusted:
            return
        self.depends_on |= report.depends_on
        if was_trusted:
            self._step(n, report)
            return
        block = slice(6 * n, 6 * n + 6)
        belief.P[block], belief.P[:, block] = 0.0, 0.0
        belief.P[block, block] = report.P
        member.R, member.p = report.R[0], report.p[0]
        self._relate(n, report)

    def _least(self, report: Report) -> float:
        """Return the share of its covariance that is added to a sender's: a little if it depends on others.

        Where senders depend on this vehicle in turn, what they tell may be its own words, and all of them count once.
        """
        if not report.depends_on:
            return 0.0
        own = int(mask_of({self.vehicle}))
        if not report.depends_on & own:
            return LEAST_FORGIVEN
        return float(sum(bool(contact.last.depends_on & own) for contact in self.contacts.values()))

    def _step(self, n: int, report: Report) -> None:
        """Put a trusted sender where it says that it is; the step d there tells of all errors that correlate with it.

        The sender's error after it is not correlated with it, so that its covariance with other errors is the
        difference of theirs with the sender's before and after, and its own is N = P- - P+.
        """
        belief, member, after = self.belief, self.belief.members[n], report.P
        block = slice(6 * n, 6 * n + 6)
        d = left_error(member.R, member.p, report.R[0], report.p[0])
        G = recentring(d)
        belief.P[block] = G.dot(belief.P[block])
        belief.P[:, block] = belief.P[:, block].dot(G.T)
        member.R, member.p = report.R[0], report.p[0]
        d, before = G.dot(d), belief.P[block].copy()
        crosses = self.correlations.crosses(belief, n, after, False)
        row, forgiven = regress(belief.P, n, after, crosses, True, self._least(report))
        D = before - row
        D[:, block] = -forgiven * after
        before = before[:, block]
        belief.P[block], belief.P[:, block] = row, row.T
        N = before - (1.0 - forgiven) * after + LEAST_NEWS * np.diag(before.diagonal())
        vague = before[3:, 3:].trace() > 3.0 * MAX_TOLD_VARIANCE
        if forgiven < 0.0 or vague or not is_positive(N) or d.dot(np.linalg.solve(N, d)) > STEP_GATE:
            return
        free = 12 if belief.errors is not None else 6
        K = np.linalg.solve(N, D[:, :free]).T
        belief.P[:free] -= K.dot(D)
        belief.P[free:, :free] = belief.P[:free, free:].T
        dx = np.zeros(len(belief.P))
        dx[:free] = K.dot(d)
        belief.shift_about(dx)


def _rank(report: Report) -> tuple[int, int]:
    """Return a key that is larger for who depends on more others, and then for later ones."""
    return report.depends_on.bit_count(), report.vehicles[0]
