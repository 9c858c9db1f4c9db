"""Which topics of a bag are read, as what of which car; what is missing is said by name."""

from collections.abc import Mapping
from dataclasses import dataclass

from coopenv.backends.bags.names import PATTERNS
from coopenv.backends.bags.topic_map import BagCar, TopicMap
from coopenv.errors import DataError, listed, suggest
from coopenv.svea.reading import READERS
from coopenv.svea.topics import Role

VELOCITY = {"wheel+imu": (Role.WHEEL, Role.IMU), "odometry": (Role.ODOMETRY,), "wheel": (Role.WHEEL,)}
"""Where body twists may come from, best first."""
CAMERA = (Role.DETECTIONS, Role.BEARINGS)
PLACE = (Role.ESTIMATE, Role.POINT)

TRUTH = "truth"
"""The source of motion capture, as the sources of other topics have the name of their car."""


@dataclass(frozen=True)
class Chosen:
    """A topic that is read."""

    topic: str
    car: str
    role: Role
    leads: bool = False  # whether the car is a moving landmark

    @property
    def told_as(self) -> Role:
        """As what ticks are told it: motion capture of a moving landmark is where that says it is."""
        return Role.ESTIMATE if self.leads and self.role is Role.TRUTH else self.role

    @property
    def needed(self) -> bool:
        """Whether there are no ticks without it."""
        return self.leads or self.role not in (Role.CAMERA_INFO, Role.TRUTH)

    @property
    def source(self) -> str:
        """Whose clock makes its stamps."""
        return TRUTH if self.role is Role.TRUTH else self.car


def select(given: TopicMap, topics: Mapping[str, str], where: str) -> list[Chosen]:
    """Return the topics that are read.

    Args:
        given: the map.
        topics: type of every topic that there is.
        where: names the bag in errors.

    Raises:
        DataError: one that is needed is not there, or holds messages that cannot be read as what the map says.
    """
    chosen = []
    for car in given.cars:
        there = _there(given, car, topics, where)
        roles = _place(car, there, given, topics, where) if car.landmark else _needed(car, there, given, topics, where)
        chosen += [
            Chosen(there[role], car.name, role, car.landmark is not None) for role in (*roles, *_of_use(car, there))
        ]
    return chosen


def _there(given: TopicMap, car: BagCar, topics: Mapping[str, str], where: str) -> dict[Role, str]:
    """Return the topics of a car that the bag has, by role; one that the map itself names has to be there."""
    found = {}
    for role, names in candidates(given, car).items():
        for name in names:
            if name in topics:
                found[role] = name
                break
    for role, name in car.topics.given.items():
        if name not in topics:
            raise DataError(f"{given.path.name}: cars.{car.name}.topics.{role}: {_absent(name, topics, where)}")
    for role, name in found.items():
        if topics[name] not in READERS[role]:
            kinds = f"{topics[name] or 'several types'}, {role} is one of {listed(list(READERS[role]))}"
            raise DataError(f"{where}: topic {name} of {car.name} holds {kinds}")
    return found


def candidates(given: TopicMap, car: BagCar) -> dict[Role, tuple[str, ...]]:
    """Return the names that topics of a car may have, by role."""
    scheme = {
        role: tuple(pattern.format(**car.names) for pattern in patterns)
        for role, patterns in PATTERNS[given.names].items()
    }
    return scheme | {role: (name,) for role, name in car.topics.given.items()}


def _needed(
    car: BagCar, there: Mapping[Role, str], given: TopicMap, topics: Mapping[str, str], where: str
) -> list[Role]:
    """Return the roles of the odometry and the camera of a vehicle."""
    ways = [VELOCITY[given.odometry]] if given.odometry != "auto" else list(VELOCITY.values())
    way = next((way for way in ways if all(role in there for role in way)), None)
    if way is None:
        raise _missing(
            "odometry", car, [role for way in ways for role in way if role not in there], given, topics, where
        )
    eyes = [Role(given.camera)] if given.camera != "auto" else list(CAMERA)
    eye = next((role for role in eyes if role in there), None)
    if eye is None:
        raise _missing("camera", car, eyes, given, topics, where)
    return [*way, eye]


def _place(
    car: BagCar, there: Mapping[Role, str], given: TopicMap, topics: Mapping[str, str], where: str
) -> list[Role]:
    """Return the role that tells where a moving landmark is; motion capture stands in where it does not say itself."""
    for role in (*PLACE, Role.TRUTH):
        if role in there:
            return [role]
    raise _missing("position", car, [*PLACE, Role.TRUTH], given, topics, where)


def _of_use(car: BagCar, there: Mapping[Role, str]) -> list[Role]:
    """Return the roles that are read where they are there."""
    return [] if car.landmark else [role for role in (Role.CAMERA_INFO, Role.TRUTH) if role in there]


def _missing(
    what: str, car: BagCar, roles: list[Role], given: TopicMap, topics: Mapping[str, str], where: str
) -> DataError:
    """Return the error about a car of which the bag has nothing of a kind."""
    names = [name for role in dict.fromkeys(roles) for name in candidates(given, car).get(role, ())]
    if not names:
        kinds = listed([role.value for role in dict.fromkeys(roles)])
        return DataError(f"{given.path.name}: cars.{car.name}.topics: names no topic of its {what} ({kinds})")
    return DataError(f"{car.name} has no {what}: {_absent(names[0], topics, where)}")


def _absent(name: str, topics: Mapping[str, str], where: str) -> str:
    known = listed(sorted(topics)) or "none at all"
    return f"{where} has no topic {name}{suggest(name, topics)}; it has {known}"
