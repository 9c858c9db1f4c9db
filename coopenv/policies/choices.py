"""Choices above steering: whom to serve, a heading beside the route, a pace; a vehicle keeps each for half a second.

A rule, or a learned policy, chooses a letter of the alphabet; the driver steers. An episode then has few choices, each
with an effect, and a clone of a rule is exact: letters are classes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario

KEPT = 0.5
"""Time (s) for which a choice is kept."""
OFFSETS, PACES = (0.0, 0.4, -0.4), (1.0, 0.5)
"""Headings beside the route, rad, and shares of the top speed."""
AHEAD, ASIDE = 2.0, 1.3
"""Place (m) at which a vehicle is served: so far in front of it, and so far to the side from which the helper comes."""
CROSSING = 0.9
"""Largest angle (rad) to the way of the served vehicle at which a helper crosses over to it."""
NEAR, SLOWEST = 0.4, 0.15
"""Distance (m) aside from which on a helper crosses at half of its top speed at least; least speed, m/s."""
GAIN = 0.8
"""Increase of the speed per metre that the place of serving is ahead, 1/s."""


class Choice(NamedTuple):
    """One letter of the alphabet."""

    served: int | None = None
    """Place of the served vehicle among the senders of messages; None: the vehicle follows its route."""
    offset: float = 0.0
    """Heading beside the route, rad to the left."""
    pace: float = 1.0
    """Share of the top speed."""


class Choices(RouteFollower):
    """The route follower under choices; without a choice of its own every vehicle follows its route at top speed.

    A served vehicle measures its helper: the helper drives `AHEAD` m in front of it, `ASIDE` m aside. Where no message
    of the served vehicle is at hand, the helper follows its route.
    """

    needs: tuple[str, ...] = ("message_position", "message_forward", "message_mask", "route_heading")
    remembers = 2  # decisions until the next choice, and the present letter
    chooser: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    """Letters of a learned policy in place of `choose`, from observations and flags (rows,) of the rows that choose."""

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        senders = self.layout["message_mask"].shape[0]
        routes = [Choice(None, offset, pace) for offset in OFFSETS for pace in PACES]
        self.alphabet = (*routes, *(Choice(sender) for sender in range(senders)))
        """All letters; the first is the route at top speed, the last ones serve each of the senders."""
        self.first_served = len(routes)
        """Number of the letter that serves the first sender."""
        self.kept = max(1, round(KEPT * scenario.rates.decision))
        """Decisions for which a choice is kept."""
        self._offset = np.array([choice.offset for choice in self.alphabet])
        self._pace = np.array([choice.pace for choice in self.alphabet])
        top = np.array([limits.max_speed for limits in scenario.limits])
        others = np.array([np.delete(top, vehicle) for vehicle in range(len(top))])
        self._their_speed = others if self.senders_known else np.full((len(top), senders), top.max())

    def choose(self, observations: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Return the next letters, (rows,), from observations and the present letters: here those of the route."""
        return np.zeros(len(observations), dtype=int)

    def letters(self, observations: np.ndarray) -> np.ndarray:
        """Return the letters, (rows,), that it chooses where all rows choose now; none is taken."""
        before, present = self._reported, self.memory(observations)[1]
        seen = np.concatenate([observations, self.leaps(observations)], axis=1)
        self._reported = before  # the jumps of this decision are found once more on driving
        return self._chosen(seen, present, np.ones(len(seen), dtype=bool))

    def _chosen(self, observations: np.ndarray, present: np.ndarray, rows: np.ndarray) -> np.ndarray:
        if self.chooser:
            return self.chooser(observations[:, : self.layout.size], rows)
        return self.choose(observations, present)

    def matches(self, other: "Choices | None") -> bool:
        """Return whether letters mean the same to another driver."""
        meaning = [(one.alphabet, one.kept, type(one).follow) for one in (self, other) if one]
        return meaning[:1] == meaning[1:]

    def take(self, letters: np.ndarray) -> None:
        """Follow letters, (rows,), for the next `kept` decisions in place of choices of its own."""
        left, letter = self.memory(letters)
        left[:], letter[:] = self.kept, letters

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        left, letter = self.memory(observations)
        due = left == 0
        if due.any():
            letter[due] = self._chosen(observations, letter, due)[due]
        left[due] = self.kept
        left -= 1
        return self.follow(observations, letter)

    def follow(self, observations: np.ndarray, letter: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return speed, m/s, and turn (see `pursue`) of letters, (rows,) each."""
        offset = self._offset[letter]
        aside = offset - self.read(observations, "route_heading")[:, 0]
        direction = np.where(offset != 0.0, aside, self.direction(observations))
        speed = self._pace[letter] * self.cruise
        served, towards, pace = self._serving(observations, letter)
        direction, speed = np.where(served, towards, direction), np.where(served, pace, speed)
        points, distance = self.route_points(observations)
        leg = distance[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)[:, None]
        leaves = served | (offset != 0.0)
        allowed = self.speed(observations, np.where(leaves[:, None, None], leg, points))
        return np.minimum(speed, allowed), self.pursue(direction)

    def _serving(self, observations: np.ndarray, letter: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return flags of rows that serve a vehicle now, the direction to drive in, rad, and the speed, m/s."""
        mask, place, forward = self.reported(observations)
        rows, sender = np.arange(len(letter)), np.maximum(letter - self.first_served, 0)
        serves = (letter >= self.first_served) & mask[rows, sender]
        there, ahead = place[rows, sender], forward[rows, sender]
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
        side = np.where((there * left).sum(axis=-1) > 0.0, -1.0, 1.0)  # the helper's, seen from the served vehicle
        target = there + AHEAD * ahead + (ASIDE * side)[:, None] * left
        across, along = (target * left).sum(axis=-1), (target * ahead).sum(axis=-1)
        turn = np.clip(np.arctan2(across, self.look_ahead), -CROSSING, CROSSING)
        vehicle = rows % len(self._their_speed)
        speed = np.clip(self._their_speed[vehicle, sender] + GAIN * along, SLOWEST, self.cruise)
        speed = np.where(np.abs(across) > NEAR, np.maximum(speed, self.cruise / 2.0), speed)
        return serves, np.arctan2(ahead[:, 1], ahead[:, 0]) + turn, speed


def choices_of(policy: Any) -> Choices | None:
    """Return the driver with the alphabet of a policy that chooses letters, None for others."""
    found = getattr(policy, "choices", policy)
    return found if isinstance(found, Choices) else None
