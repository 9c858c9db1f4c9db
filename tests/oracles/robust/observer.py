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

from copy import deepcopy
from dataclasses import replace

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Estimate, Setup, Tick
from coopenv.observers.robust.constants import (
    ADMISSION,
    DISPUTE_MARGIN,
    DRIFT_CLEAR,
    DRIFT_GATE,
    ENOUGH_LANDMARKS,
    ERROR_FACTOR,
    ERRORS_TIME,
    GROSS_ERROR,
    GROSS_TURN,
    KNOWN_ANGLE,
    KNOWN_POSITION,
    LEAST_FORGIVEN,
    LEAST_NEWS,
    LOST_SHARE,
    LOST_TIME,
    MAX_REVISIONS,
    MAX_SPEED,
    MAX_TOLD_ANGLE,
    RETURNING_SHARE,
    REVISION_MARGIN,
    SAME_TIME,
    SEPARATION_GATE,
    SILENCE_TIME,
    STEP_GATE,
    WORD_GATE,
)
from tests.oracles.robust.alone import Alone, cost_of, most_of_consistent
from tests.oracles.robust.belief import Member, recentring
from tests.oracles.robust.clocks import by_clocks, changes_speed
from tests.oracles.robust.common import Anchor, Contact
from tests.oracles.robust.eviction import room_for
from tests.oracles.robust.odometry import as_noise
from tests.oracles.robust.revision import Explanation, Told, explained, separation
from tests.oracles.robust.sight import View
from tests.oracles.robust.speaking import Speaking
from tests.oracles.robust.told import Correlations, is_positive, regress
from tests.oracles.robust.tracklets import Report, left_error, mask_of
from tests.oracles.robust.words import Word, has_jumped, least_drift, share_of

KEPT = ("drift", "slow_drift", "perjured", "offences", "barred_until")
"""Of what is thought of a sender, what bearings have not told."""


class Robust(Speaking):
    """One vehicle's observer; messages hold pose and covariance (172 bytes), at times correlations (256 bytes)."""

    def __init__(self, setup: Setup) -> None:
        """Take what the vehicle knows before it starts."""
        super().__init__(setup)
        self.correlations = Correlations()
        self.words: dict[int, Word] = {}
        self.clock_std = setup.noise.clock_offset

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose, and with no opinion of anybody."""
        super().reset(initial_pose, initial_covariance)
        self.words = {}
        self.accused: tuple[int, float, bool] | None = None
        self.exposed = False
        self.alone: Alone | None = None
        if self.search is None:
            self.depends_on = 0
            own = self.belief.own
            self.alone = Alone(own.R, own.p, self.belief.P[:6, :6], self.odometry, 0.0)

    def update(self, tick: Tick) -> Estimate:
        """Take one camera tick; what is told is noted during a search, too."""
        for target, received in tick.messages.items():
            self.correlations.hear(target - self.landmarks, received.message, tick.time - received.age)
        return super().update(tick)

    def _listen(self, tick: Tick) -> None:
        """Take in the messages of members that count, and those of others in view, leaders first."""
        in_view = {target - self.landmarks for target in tick.targets[tick.valid].tolist()}
        reports = {report.vehicles[0]: report for report in self._reports(tick)}
        self._notice(in_view, list(reports.values()), tick.time)
        news = {s: r for s, r in reports.items() if "told" in tick.messages[s + self.landmarks].message.extra}
        last = {sender: float(contact.last.time[0]) + SAME_TIME for sender, contact in self.contacts.items()}
        pending = {s: r for s, r in news.items() if s in last and r.time[0] > last[s]}
        while pending:
            taken = {sender: float(contact.last.time[0]) for sender, contact in self.contacts.items()}
            s = min(pending, key=lambda s: (self.correlations.has_to_wait(s, pending, taken), *pending[s].rank))
            self._hear(self.contacts[s], pending.pop(s), tick.time)
        for report in sorted(reports.values(), key=lambda report: report.rank):
            sender = report.vehicles[0]
            if sender in in_view and sender not in self.contacts and not self._is_barred(sender, tick.time):
                self._meet(report, tick.time)

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
        member.untold = bool(self.depends_on & int(mask_of(told)))
        self._relate(len(self.belief.members) - 1, report)
        self.depends_on |= report.depends_on | int(mask_of(told))

    def _relate(self, n: int, report: Report) -> None:
        """Let the error of a sender that has just been met depend on those of the others as told."""
        crosses = self.correlations.crosses(self.belief, n, report.P, True)
        row, _, told = regress(self.belief.P, n, report.P, crosses, False, self._least(report))
        self.belief.members[n].untold &= not told
        block = slice(6 * n, 6 * n + 6)
        self.belief.P[block], self.belief.P[:, block] = row, row.T

    def _hear(self, contact: Contact, report: Report, time: float) -> None:
        """Put a sender where it says that it is, and let one's own pose follow what it has learnt."""
        last, sender = contact.last, report.vehicles[0]
        dt, step = float(report.time[0] - last.time[0]), report.motion_since(last, 0)[1]
        contact.last = report
        belief, n = self.belief, self.belief.place(sender)
        assert n is not None
        jumped = has_jumped(belief.members[n], step, dt, self.noise)
        belief.follow(n, report.odometry_turn[0], report.odometry_position[0], float(report.time[0]), self.noise)
        steady = not changes_speed(belief, n, self.clock_std)
        word = self._word(sender)
        word.step(last, report, self.noise, belief.errors_covariance, contact.trusted)
        drift = word.drifted(DRIFT_GATE, least_drift(report)) if contact.trusted else word.drifted(DRIFT_CLEAR, 0.0)
        anew = self._decide(contact, report, time, dt, drift, jumped)
        if not contact.trusted:
            return
        self.depends_on |= report.depends_on
        report = replace(report, P=report.P + by_clocks(belief.members[n], self.clock_std))
        if not anew:
            lasting = as_noise(belief.errors_covariance, step, dt, ERRORS_TIME)
            known = bool((lasting <= self.noise.odometry(dt)).all())
            belief.P[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] -= np.diag(lasting)  # what that takes is no news
            self._step(n, report, steady and known and not report.depends_on_vehicle(self.vehicle))
            return
        self._place(sender, report)

    def _place(self, sender: int, report: Report) -> None:
        """Put a member where its report says that it is, whatever was believed of it before."""
        belief, n = self.belief, self.belief.place(sender)
        assert n is not None
        member, block = belief.members[n], slice(6 * n, 6 * n + 6)
        member.considered = True
        belief.P[block], belief.P[:, block] = 0.0, 0.0
        belief.P[block, block] = report.P
        member.R, member.p = report.R[0], report.p[0]
        self._relate(n, report)

    def _separate(self, tick: Tick) -> None:
        """Judge whom bearings contradict, and now and then the belief as a whole by what landmarks alone say."""
        accused, self.accused = self.accused, None
        if self.search is not None:
            self.alone = None
        elif tick.due:
            own = self.belief.own
            if self.alone is None:
                P = np.diag(np.repeat([KNOWN_ANGLE**2, KNOWN_POSITION**2], 3))
                self.alone = Alone(own.R, own.p, P, self.odometry, tick.time)
            self.exposed = self.exposed or any(member.considered for member in self.belief.members)
            if accused is not None:
                self._judge_accused(tick, *accused)
            elif self.alone.is_due(tick.time):
                self._judge_belief(tick)
                if self.alone is not None:
                    self._revise(tick)

    def _judge_accused(self, tick: Tick, sender: int, error: float, followed: bool) -> None:
        """Believe a sender no more that bearings contradict, or else the one that it contradicts: who landmarks do."""
        assert self.alone is not None
        self.alone.follow(self.odometry, tick.time, self.noise, self.belief.errors_covariance)
        costs = self._costs_without(tick)
        culprit = min(costs, key=costs.__getitem__, default=sender)
        if sender in costs and costs[sender] - costs[culprit] > DISPUTE_MARGIN:
            self._stand_alone(tick, culprit)
        else:
            self._distrust(self.contacts[sender], tick.time, error, followed)

    def _judge_belief(self, tick: Tick) -> None:
        """Leave the belief where it is not what landmarks alone say; but that is wrong where many contradict it."""
        assert self.alone is not None
        dt = self.alone.follow(self.odometry, tick.time, self.noise, self.belief.errors_covariance)
        fits = self.alone.correct(tick, self.landmarks, self.variance, self.mounting[[0, 3]], dt)
        if self.alone.lost:
            self.alone = None
            return
        own = self.belief.own
        if fits == 0 or not self.exposed or separation(self.alone.belief, own.R, own.p) <= SEPARATION_GATE:
            return
        costs = self._costs_without(tick)
        if fits >= ENOUGH_LANDMARKS or not costs or min(costs.values()) <= most_of_consistent(len(costs) - 1):
            self._stand_alone(tick, min(costs, key=costs.__getitem__, default=-1))
        else:
            self.alone = None

    def _revise(self, tick: Tick) -> None:
        """Believe others than so far where that explains this frame's bearings better."""
        assert self.alone is not None
        words = self._words_in_view(tick)
        if not any(word.rejected for word in words):
            return
        setting = tick.lever_arm, self.variance + self.mounting[0]
        now = explained(self.alone.belief, words, *setting)
        best, liar = Explanation(np.inf, self.belief.own.R, self.belief.own.p), -1
        for lying in words:
            but = [word._replace(rejected=word is lying) for word in words]
            found = explained(self.alone.belief, but, *setting)
            if found.cost < best.cost:
                best, liar = found, lying.vehicle
        elsewhere = separation(self.belief, best.R, best.p) > SEPARATION_GATE
        if not elsewhere or not now.cost - best.cost > REVISION_MARGIN:
            return
        for word in words:
            if word.vehicle != liar and not self.contacts[word.vehicle].trusted:
                self._believe_again(word.vehicle)
        self._stand_alone(tick, liar)
        if self.contacts[liar].trusted:
            self._distrust(self.contacts[liar], tick.time, 0.0, False)

    def _is_disputed(self, sender: int) -> bool:
        """Return whether a sender is not believed because of bearings, and has not been so too often before."""
        word = self._word(sender)
        return not self.contacts[sender].trusted and not word.perjured and word.offences <= MAX_REVISIONS

    def _believe_again(self, sender: int) -> None:
        """Put a sender where it says to be."""
        word, contact = self._word(sender), self.contacts[sender]
        self.words[sender] = Word(drift=word.drift, slow_drift=word.slow_drift, offences=word.offences)
        contact.trusted = True
        self.depends_on |= contact.last.depends_on
        self._place(sender, replace(contact.last, P=contact.last.P + self._clocks_of(sender)))

    def _clocks_of(self, sender: int) -> Array:
        """Return (6, 6) the covariance of how far a sender that has been met is off by clocks."""
        n = self.belief.place(sender)
        assert n is not None
        return by_clocks(self.belief.members[n], self.clock_std)

    def _words_in_view(self, tick: Tick) -> list[Told]:
        """Return where members in view say to be that may be right."""
        words = []
        reports = {report.vehicles[0]: report for report in self._reports(tick)}
        for target, bearing in zip(tick.targets[tick.valid], tick.bearings[tick.valid], strict=True):
            sender = int(target) - self.landmarks
            contact = self.contacts.get(sender)
            if contact is None or sender not in reports or not (contact.trusted or self._is_disputed(sender)):
                continue
            report = reports[sender]
            gone = MAX_SPEED * (tick.time - float(report.time[0]))
            P = report.P + self._clocks_of(sender)
            variance = float(P[3:6, 3:6].trace()) / 3.0 + gone**2 + float(self.mounting[3])
            rejected = not contact.trusted or self._word(sender).missed > LOST_SHARE
            words.append(Told(sender, bearing, report.p[0], variance, rejected))
        return words

    def _costs_without(self, tick: Tick) -> dict[int, float]:
        """Return what bearings to believed senders cost without each of them, were one where landmarks alone say."""
        assert self.alone is not None
        held = self.belief
        self.belief = deepcopy(held)
        self.alone.replace_own(self.belief)
        view = self._view(tick)
        believed = self._believed_in(view)
        costs = {s: cost_of(view, self.belief.P, [k for t, k in believed.items() if t != s]) for s in believed}
        self.belief = held
        return costs

    def _believed_in(self, view: View) -> dict[int, int]:
        """Return the bearings of a frame to members that are believed, by vehicle."""
        of = [self._target_of(view, k) for k in range(len(view.fits))]
        return {member.vehicle: k for k, member in enumerate(of) if member is not None and member.considered}

    def _stand_alone(self, tick: Tick, culprit: int) -> None:
        """Believe what landmarks alone say, and a culprit and all that contradict landmarks by themselves no more."""
        assert self.alone is not None
        belief, alone = self.belief, self.alone.belief.own
        away = float(np.linalg.norm(alone.p - belief.own.p))
        self.alone.replace_own(belief)
        self._forget_errors()
        self._forget_evidence()
        for n, member in enumerate(belief.members):
            if n >= belief.others and not member.considered:
                belief.P[6 * n + 3 : 6 * n + 6, 6 * n + 3 : 6 * n + 6] += away**2 * np.eye(3)
        self.missed = 0.0
        self.exposed = False
        self.anchor = Anchor(alone.R, alone.p, self.alone.belief.P.copy(), self.odometry, tick.time)
        view = self._view(tick)
        for sender, k in self._believed_in(view).items():
            if sender == culprit or not view.fits[k]:
                off = float(np.linalg.norm(view.sight.residual[k]) * view.sight.distance[k])
                self._distrust(self.contacts[sender], tick.time, off, False)

    def _forget_errors(self) -> None:
        """Believe of the odometry's errors and of the mounting what is declared."""
        belief, end = self.belief, 6 * self.belief.others
        fresh = self._alone(belief.own.R, belief.own.p, belief.P[:6, :6])
        belief.members[1 : belief.others] = fresh.members[1:]
        belief.P[6:end], belief.P[:, 6:end] = 0.0, 0.0
        belief.P[6:end, 6:end] = fresh.P[6:, 6:]

    def _lose(self, time: float) -> None:
        """Search anew, without what bearings have said of others from where the vehicle is not."""
        super()._lose(time)
        self.alone = None
        self._forget_evidence()

    def _forget_evidence(self) -> None:
        """Forget what bearings have said of others: they were taken from where the vehicle is not."""
        for sender, word in self.words.items():
            self.words[sender] = replace(Word(), **{name: getattr(word, name) for name in KEPT})

    def _word(self, sender: int) -> Word:
        """Return what is thought of a sender's word."""
        return self.words.setdefault(sender, Word())

    def _is_barred(self, sender: int, time: float) -> bool:
        return self._word(sender).is_barred(time)

    def _decide(self, contact: Contact, report: Report, time: float, dt: float, drift: float, jumped: bool) -> bool:
        """Decide whether a sender is believed; return whether it starts anew."""
        if not contact.trusted:
            self._judge(contact, report, dt)
            if self._is_barred(report.vehicles[0], time) or drift > 0.0:
                contact.trusted, contact.agreed = False, 0.0
            return contact.trusted
        if self._admits(report, dt):
            return True
        self._judge(contact, report, dt)
        if jumped or not contact.trusted or drift > 0.0:
            error = 0.0 if jumped or not contact.trusted else drift
            self._distrust(contact, time, error, error > 0.0)
            self._word(report.vehicles[0]).perjured = True
        return False

    def _admits(self, report: Report, dt: float) -> bool:
        """Take note where a report admits an error; return whether its sender starts anew."""
        belief, n = self.belief, self.belief.place(report.vehicles[0])
        assert n is not None
        block = slice(6 * n, 6 * n + 6)
        spread = belief.P[block, block][3:, 3:].trace()
        grown = report.P[3:6, 3:6].trace() - spread
        if grown > ADMISSION * spread:
            self._reopen(n, grown / 3.0)
        member = belief.members[n]
        e = left_error(member.R, member.p, report.R[0], report.p[0])
        if dt > SILENCE_TIME and e.dot(np.linalg.solve(belief.P[block, block] + report.P[:6, :6], e)) > STEP_GATE:
            self._reopen(n, float(e[3:].dot(e[3:])))
            return True
        return False

    def _reopen(self, n: int, variance: float) -> None:
        """Let all that depends on what a member said be uncertain again."""
        self.belief.enlarge(n, variance)
        if variance > GROSS_ERROR**2:
            self.belief.P[:6, :6] += variance * np.diag(np.repeat([GROSS_TURN**2, 1.0], 3))

    def _distrust(self, contact: Contact, time: float, error: float, believed: bool) -> None:
        """Believe a sender no more, which is off by some metres; `believed`: one's own pose has followed that."""
        sender = contact.last.vehicles[0]
        n = self.belief.place(sender)
        assert n is not None
        if believed:
            self._reopen(n, (ERROR_FACTOR * error) ** 2)
        self.belief.P[6 * n + 3 : 6 * n + 6, 6 * n + 3 : 6 * n + 6] += error**2 * np.eye(3)
        self.belief.members[n].considered = contact.trusted = False
        contact.agreed = 0.0
        self.words[sender] = self._word(sender).offend(time)

    def _weigh(self, tick: Tick, noise: Array) -> None:
        """Weigh a frame's bearings against what members say; believe the one no more that they contradict most."""
        worst, most, error = None, WORD_GATE, 0.0
        share = share_of(self.variance, noise, tick.dt)
        for n, member in enumerate(self.belief.members):
            if member.considered:
                position, word = slice(6 * n + 3, 6 * n + 6), self._word(member.vehicle)
                P = self.belief.P[position, position]
                correction = self.belief.full_correction[position]
                spread = self.belief.full_covariance[position, position]
                word.weigh(member.R, P, correction, spread, share)
                size, far = word.contradiction(member.R, P)
                if size > most:
                    worst, most, error = member.vehicle, size, far
        if worst is not None:
            self._accuse(worst, error, True)

    def _accuse(self, sender: int, error: float, followed: bool) -> None:
        """Say that bearings contradict a sender, if they do no other: it is off by some metres."""
        if self.accused is None:
            self.accused = sender, error, followed

    def _target_of(self, view: View, k: int) -> Member | None:
        """Return the member that a bearing is to, None if it is to a landmark."""
        others = self.belief.others
        of = np.flatnonzero(view.sight.H[k, :, 6 * others :].any(axis=0))
        return self.belief.members[others + int(of[0]) // 6] if len(of) else None

    def _count(self, tick: Tick, view: View) -> None:
        """Average which share of the bearings to each member do not fit; believe those no more to which most do not.

        Only while those to most targets do: otherwise it may be the vehicle itself that is lost.
        """
        of = [self._target_of(view, k) for k in range(len(view.fits))]
        balance = 0
        for member, fits in zip(of, view.fits.tolist(), strict=True):
            good, counts = fits, True
            if member is not None:
                word = self._word(member.vehicle)
                word.missed += (float(not fits) - word.missed) * min(1.0, tick.dt / LOST_TIME)
                word.fitted += fits * tick.dt
                good, counts = word.missed < 0.5, self.contacts[member.vehicle].trusted
            balance += (2 * int(good) - 1) * counts
        for k, member in enumerate(of if balance > 0 else []):
            if view.fits[k]:
                continue
            if member is not None and member.considered and self._word(member.vehicle).missed > LOST_SHARE:
                far = float(np.linalg.norm(view.sight.residual[k]) * view.sight.distance[k])
                fitted = self._word(member.vehicle).fitted > LOST_TIME
                self._accuse(member.vehicle, far, fitted)

    def _least(self, report: Report) -> float:
        """Return the share of its covariance that is added to a sender's: a little if it depends on others.

        Where senders depend on this vehicle in turn, what they tell may be its own words, and all of them count once.
        """
        if not report.depends_on:
            return 0.0
        if not report.depends_on_vehicle(self.vehicle):
            return LEAST_FORGIVEN
        return float(sum(contact.last.depends_on_vehicle(self.vehicle) for contact in self.contacts.values()))

    def _only_returns(self, member: Member) -> bool:
        """Return whether a member may say what this vehicle knows already, and knows its place hardly better."""
        report = self.contacts[member.vehicle].last if member.considered else None
        if report is None or not (member.untold or report.depends_on_vehicle(self.vehicle)):
            return False
        return bool(report.P[3:6, 3:6].trace() > RETURNING_SHARE * self.belief.P[3:6, 3:6].trace())

    def _step(self, n: int, report: Report, following: bool) -> None:
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
        row, more, told = regress(belief.P, n, after, crosses, True, self._least(report))
        member.untold &= not told
        D = before - row
        D[:, block] = -more
        before = before[:, block]
        belief.P[block], belief.P[:, block] = row, row.T
        N = before - after + more + LEAST_NEWS * np.diag(before.diagonal())
        reach = MAX_TOLD_ANGLE * float(np.linalg.norm(member.p - belief.own.p))
        vague = before[3:, 3:].trace() > 3.0 * reach**2
        if not following or vague or not is_positive(N) or d.dot(np.linalg.solve(N, d)) > STEP_GATE:
            return
        free = 6 * belief.others
        K = np.linalg.solve(N, D[:, :free]).T
        belief.P[:free] -= K.dot(D)
        belief.P[free:, :free] = belief.P[:free, free:].T
        dx = np.zeros(len(belief.P))
        dx[:free] = K.dot(d)
        belief.shift_about(dx)
