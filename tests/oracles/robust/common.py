"""What the observers `robust` and `robust_joint` have in common: all but what vehicles tell each other."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.coordinates import Coordinates
from coopenv.estimation.rotations import orthonormalise
from coopenv.observers.contract import Estimate, Message, SensorNoise, Setup, Tick
from coopenv.observers.robust.constants import (
    AGREEMENT_DISTANCE,
    AGREEMENT_GATE,
    AGREEMENT_TIME,
    ANCHOR_ANGLE_VARIANCE,
    ANCHOR_POSITION_VARIANCE,
    BEARING_GATE,
    DOUBT_TIME,
    ERRORS_TIME,
    HEALTHY_SHARE,
    HEALTHY_TIME,
    LOST_SHARE,
    LOST_TIME,
    MAX_ACCELERATION,
    MAX_MEMBERS,
    MAX_SPEED,
    MESSAGE_GATE,
    MIN_ANGULAR_VELOCITY_STD,
    MIN_MOUNTING_STD,
    MIN_VELOCITY_STD,
    MOUNTING_WALK,
    SAME_TIME,
    SURE,
    VELOCITY_TIME,
)
from tests.oracles.robust.belief import Belief, Member, averaging_time
from tests.oracles.robust.matrices import solve_positive
from tests.oracles.robust.odometry import Lasting, as_noise, trapezoidal
from tests.oracles.robust.resection import resect
from tests.oracles.robust.search import Search, Sighting, is_known
from tests.oracles.robust.sight import View
from tests.oracles.robust.tracklets import Report, from_message, left_error, mask_of, to_message


@dataclass
class Contact:
    """What is known of a sender."""

    last: Report
    trusted: bool = True
    agreed: float = 0.0
    """s, for which a distrusted sender has agreed."""


@dataclass(frozen=True)
class Anchor:
    """Where the vehicle was when its bearings last fitted, or at the start."""

    R: Array  # (3, 3) body to map
    p: Array  # (3,) map frame, m
    P: Array  # (6, 6) left error, rad and m
    odometry: tuple[Array, Array]
    """(3, 3) and (3,) m: its pose by dead reckoning then."""
    time: float  # s


class Common:
    """One vehicle's observer, but for `_listen`: what it makes of messages."""

    most_members = MAX_MEMBERS
    """The vehicle itself and those it keeps in its belief."""

    def __init__(self, setup: Setup) -> None:
        """Take what the vehicle knows before it starts."""
        self.vehicle, self.landmarks, self.marker = setup.vehicle, setup.landmarks, setup.marker
        self.noise = SensorNoise(
            max(setup.noise.velocity, MIN_VELOCITY_STD),
            max(setup.noise.angular_velocity, MIN_ANGULAR_VELOCITY_STD),
            setup.noise.odometry_period,
            setup.noise.bearing,
        )
        self.sample_noise = setup.noise.angular_velocity, setup.noise.velocity
        self.lasting = Lasting.of(setup.noise)
        self.variance = self.noise.bearing_std**2
        stds = np.array([setup.noise.camera_orientation, setup.noise.camera_position])
        self.mounting = np.repeat(stds**2, 3) if stds.any() else np.zeros(6)
        self.possible_dependencies = int(
            mask_of({int(t) - self.landmarks for t in setup.targets if t >= self.landmarks})
        )

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose; one that is too uncertain to linearise about is only a hint for the search."""
        R, p = (np.array(x, float) for x in initial_pose)
        P = np.array(initial_covariance, float)
        self.odometry = np.eye(3), np.zeros(3)
        self.sample: tuple[Array, Array] | None = None  # held at the last tick's end
        self.contacts: dict[int, Contact] = {}
        self.depends_on = self.possible_dependencies
        self.missed, self.frame_time = 0.0, 0.0
        self.belief = self._alone(R, p, P.copy())
        self.search = None if is_known(P) else Search(self.vehicle, R, p, P.copy())
        self.anchor, self.healthy = Anchor(R, p, P, self.odometry, 0.0), 0.0

    def update(self, tick: Tick) -> Estimate:
        """Take one camera tick."""
        before, self.sample = self.sample, (tick.angular_velocity, tick.velocity)
        if before is None:
            self.mean_velocity = tick.velocity
        share = tick.dt / (tick.dt + VELOCITY_TIME)
        self.mean_velocity = self.mean_velocity + share * (tick.velocity - self.mean_velocity)
        tick, jumps = trapezoidal(tick, before, self.noise.odometry_period, self.sample_noise)
        dR, dp = self.belief.corrected(tick.rotation, tick.translation, tick.dt)
        tick = replace(tick, rotation=dR, translation=dp)
        self._walk(tick.dt)
        R, p = self.odometry
        self.odometry = orthonormalise(R.dot(tick.rotation)), p + R.dot(tick.translation)
        noise = self.noise.odometry(tick.dt) + jumps
        self.nis, self.nis_dof = 0.0, 0
        if self.search is not None:
            self.search.move(tick, noise + as_noise(self.belief.errors_covariance, dp, tick.dt, ERRORS_TIME))
            if tick.due:
                self._search(tick)
        else:
            self.belief.move(0, tick.rotation, tick.translation, noise)
            self.belief.drift(tick.rotation, self.mean_velocity, tick.dt)
            self.belief.own.time = tick.time
            self._listen(tick)
            if tick.due:
                self._look(tick)
        self._separate(tick)
        if tick.due:
            self.frame_time = tick.time
        belief = self.belief if self.search is None else self.search.best
        P, coordinates = belief.P[:6, :6].copy(), Coordinates.LEFT
        return Estimate(belief.own.R, belief.own.p, P, coordinates, self.nis if self.nis_dof else None, self.nis_dof)

    def _alone(self, R: Array, p: Array, P: Array) -> Belief:
        """Return a belief in the vehicle alone, that knows of its odometry's errors what is declared."""
        belief = Belief(self.vehicle, R, p, P)
        if self.lasting.any or self.mounting.any():
            belief.begin_errors(self.lasting.start)
        if self.mounting.any():
            belief.begin_mounting(np.diag(np.maximum(self.mounting, MIN_MOUNTING_STD**2)))
        return belief

    def _walk(self, dt: float) -> None:
        """Let the odometry's errors have walked."""
        if self.belief.errors is not None:
            walk = np.append(self.lasting.bias_walk, self.lasting.scale_walk) * dt
            self.belief.P[6:10, 6:10] += np.diag(walk)
        if self.belief.mounting is not None:
            self.belief.P[12:18, 12:18] += MOUNTING_WALK**2 * dt * np.diag(self.mounting)

    def message(self) -> Message:
        """Return pose, covariance and odometry, or nothing while the pose is not known."""
        if self.search is not None or not is_known(self.belief.P[:6, :6]):
            return Message()
        return to_message(self.belief, self.marker, self.odometry, self.depends_on)

    def _listen(self, tick: Tick) -> None:
        """Take in the messages of those in view, and of those that are already believed in."""
        raise NotImplementedError

    def _search(self, tick: Tick) -> None:
        """Look for the pose; once only one is possible, go on with the prior, or with what this frame alone says."""
        assert self.search is not None
        found = self.search.look(tick, self._sightings(tick), self.variance + self.mounting[0])
        if found is None:
            return
        if self.search.confirms_prior(found):
            self._begin(self.search.prior, tick)
            self.search = None
            self._look(tick)
            return
        self._begin(found, tick)
        if resect(self.belief, lambda: self._view(tick, True)) and is_known(SURE * self.belief.P[:6, :6]):
            self.search = None
        else:
            self.search.least_age = self.search.age + DOUBT_TIME

    def _begin(self, pose: Belief, tick: Tick) -> None:
        """Believe in a pose and in those that are in view."""
        own = pose.own
        before, self.belief = self.belief, Belief(self.vehicle, own.R, own.p, pose.P.copy(), tick.time)
        if before.errors_covariance is not None:
            self.belief.begin_errors(before.errors_covariance, before)
        if before.mounting is not None:
            self.belief.begin_mounting(before.P[12:18, 12:18], before)
        self.contacts, self.depends_on, self.missed = {}, self.possible_dependencies, 0.0
        self._listen(tick)

    def _sightings(self, tick: Tick) -> list[Sighting]:
        """Return every target in view whose place is known or told by a sender that knows it."""
        reports = {report.vehicles[0]: report for report in self._reports(tick)}
        result = []
        for n in np.flatnonzero(tick.valid):
            target = int(tick.targets[n])
            if target < self.landmarks:
                result.append(Sighting(tick.bearings[n], tick.landmarks[target], 0.0))
            elif (report := reports.get(target - self.landmarks)) is not None:
                if self._is_barred(target - self.landmarks, tick.time):
                    continue
                age = tick.time - report.time[0]
                variance = float(np.trace(report.P[3:6, 3:6])) / 3.0 + (MAX_SPEED * age) ** 2
                result.append(Sighting(tick.bearings[n], report.p[0], variance))
        return result

    def _lose(self, time: float) -> None:
        """Search anew, from where the vehicle was when most bearings fitted, carried on by its odometry."""
        anchor, (R, p) = self.anchor, self.odometry
        prior = Belief(self.vehicle, anchor.R, anchor.p, anchor.P.copy())
        since = anchor.odometry[0].T
        dt, dp = time - anchor.time, since.dot(p - anchor.odometry[1])
        self.belief = self._alone(self.belief.own.R, self.belief.own.p, self.belief.P[:6, :6])
        noise = self.noise.odometry(dt) + as_noise(self.belief.errors_covariance, dp, dt, dt)
        prior.move(0, since.dot(R), dp, noise)
        self.search = Search(self.vehicle, prior.own.R, prior.own.p, prior.P)

    def _report(self, message: Message, sender: int, time: float) -> Report | None:
        """Return what a message says."""
        return from_message(message, sender, time)

    def _reports(self, tick: Tick) -> list[Report]:
        """Return what the messages say that were heard."""
        heard = tick.messages.items()
        read = [self._report(m.message, target - self.landmarks, tick.time - m.age) for target, m in heard]
        return [report for report in read if report is not None]

    def _notice(self, in_view: set[int], reports: list[Report], time: float) -> None:
        """Remember when members were last in view; all that a member tells of count as in view when one of them is."""
        noticed = set(in_view)
        for report in reports:
            if report.vehicles[0] in self.contacts and not in_view.isdisjoint(report.vehicles):
                noticed.update(report.vehicles)
        for member in self.belief.members:
            if member.vehicle in noticed:
                member.seen = time

    def _judge(self, contact: Contact, report: Report, dt: float) -> None:
        """Decide whether a sender is believed, from its message and the belief about it."""
        n = self.belief.place(report.vehicles[0])
        if n is None:
            return
        member, block = self.belief.members[n], slice(6 * n, 6 * n + 6)
        e = left_error(member.R, member.p, report.R[0], report.p[0])
        size = float(e.dot(solve_positive(self.belief.P[block, block] + report.P[:6, :6], e)))
        if contact.trusted:
            contact.trusted, contact.agreed = size < MESSAGE_GATE, 0.0
            return
        near = size < AGREEMENT_GATE and e[3:].dot(e[3:]) < AGREEMENT_DISTANCE**2
        contact.agreed = contact.agreed + dt if near else 0.0
        contact.trusted = contact.agreed >= AGREEMENT_TIME

    def _look(self, tick: Tick) -> None:
        """Correct the belief by every bearing that fits it; search anew when most do not."""
        view = self._view(tick)
        self.nis, self.nis_dof = float(view.nis[view.fits].sum()), 2 * int(view.fits.sum())
        if view.fits.any():
            noise = self.belief.settle(view.sight, view.noise, view.fits, lambda: self._view(tick)[:2])
            self._weigh(tick, noise[view.fits])
        if view.missed is not None:
            self.missed += (view.missed - self.missed) * min(1.0, tick.dt / LOST_TIME)
            self.healthy = self.healthy + tick.dt if self.missed < HEALTHY_SHARE else 0.0
            self._count(tick, view)
            if self.missed > LOST_SHARE:
                self._lose(tick.time)
            elif self.healthy > HEALTHY_TIME:
                own = self.belief.own
                self.anchor = Anchor(
                    own.R,
                    own.p,
                    4.0 * self.belief.P[:6, :6]
                    + np.diag(np.repeat([ANCHOR_ANGLE_VARIANCE, ANCHOR_POSITION_VARIANCE], 3)),
                    self.odometry,
                    tick.time,
                )

    def _weigh(self, tick: Tick, noise: Array) -> None:
        """Weigh a frame's bearings, whose noise is (m,), against what others say."""

    def _count(self, tick: Tick, view: View) -> None:
        """Count to whom bearings do not fit."""

    def _separate(self, tick: Tick) -> None:
        """Hold the belief against what landmarks alone say."""

    def _is_barred(self, sender: int, time: float) -> bool:
        """Return whether a sender is not to be believed."""
        return False

    def _only_returns(self, member: Member) -> bool:
        """Return whether bearings to a member do not count, because it may say one's own words."""
        return False

    def _view(self, tick: Tick, resecting: bool = False) -> View:
        """Return the frame's bearings to landmarks and to members of the belief, as measurements."""
        belief = self.belief
        heard = {report.vehicles[0]: report for report in self._reports(tick)}
        known, z, drift, counts, places, points = [], [], [], [], [], []
        targets, period = tick.targets.tolist(), max(tick.time - self.frame_time, tick.dt)
        for n in tick.valid.nonzero()[0].tolist():  # landmarks come first
            vehicle = targets[n] - self.landmarks
            if vehicle < 0:
                z.append(tick.landmarks[targets[n]])
                drift.append(0.0)
                counts.append(True)
            elif (place := belief.place(vehicle)) is not None:
                if not resecting and self._only_returns(belief.members[place]):
                    continue
                member, contact = belief.members[place], self.contacts.get(vehicle)
                turned, gone, stands, variance = self._gone(member, heard.get(vehicle))
                age = tick.time - stands
                unknown = 0.0  # m, how far it may have gone, where nobody has told how fast it goes
                if age > SAME_TIME and member.v is None:
                    if not resecting:
                        continue
                    unknown = MAX_SPEED * age
                point = gone + turned.dot(member.carried(age))
                z.append(member.p + member.R.dot(point))
                places.append(place)
                points.append(point)
                variance += unknown**2 + self._drift(age, period)
                frames = max(averaging_time(self.noise) / period, 1.0)
                drift.append(variance + member.velocity_variance * max(age, 0.0) ** 2 * frames)
                counts.append(contact is None or contact.trusted)
            else:
                continue
            known.append(n)
        sight = belief.sight(
            tick.bearings[known],
            tick.lever_arm,
            np.array(z).reshape(-1, 3),
            places,
            points,
            not resecting,
            period,
        )
        variance = self.variance + (self.mounting[0] if resecting else 0.0)
        noise = variance + np.array(drift) / sight.distance**2 + sight.bend
        nis = sight.normalised(belief.P, noise)
        fits = sight.ahead & (nis < BEARING_GATE)
        judged = [fit for fit, judges in zip(fits.tolist(), counts, strict=True) if judges]
        return View(sight, noise, nis, fits, judged.count(False) / len(judged) if judged else None)

    def _gone(self, member: Member, report: Report | None) -> tuple[Array, Array, float, float]:
        """Return the increment (dR, dp) since a member's last news by its odometry, until when, and its variance."""
        if report is None or member.odometry is None or report.time[0] - member.time < SAME_TIME:
            return np.eye(3), np.zeros(3), member.time, 0.0
        R, p = member.odometry
        dR, dp = R.T.dot(report.odometry_turn[0]), R.T.dot(report.odometry_position[0] - p)
        dt = float(report.time[0]) - member.time
        noise = self.noise.odometry(dt) + as_noise(self.belief.errors_covariance, dp, dt, ERRORS_TIME)
        return dR, dp, float(report.time[0]), float(noise[3])

    def _drift(self, age: float, period: float) -> float:
        """Return the variance per axis, m^2, of where a sender is a time after its last message."""
        if age <= 0.0:
            return 0.0
        return float(self.noise.odometry(age)[3]) * max(age / period, 1.0) + (0.5 * MAX_ACCELERATION * age * age) ** 2
