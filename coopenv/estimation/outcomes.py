"""What a camera says of a target, and how an episode ends."""

from enum import IntEnum


class Sight(IntEnum):
    """Why a target is or is not measured by a camera at one tick."""

    NOT_A_NEIGHBOUR = 0
    VISIBLE = 1
    OUT_OF_VIEW = 2
    OCCLUDED_BY_BUILDING = 3
    OCCLUDED_BY_BODY = 4
    MISSED = 5


class Outcome(IntEnum):
    """How a vehicle's episode has ended so far."""

    UNDER_WAY = 0
    ARRIVED = 1
    COLLIDED = 2
    OFF_ROUTE = 3

    @property
    def words(self) -> str:
        """The name in small letters: "under way", "arrived", "collided", "off route"."""
        return self.name.lower().replace("_", " ")
