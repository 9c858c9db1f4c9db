"""What the name of a scene asks for: `lane:20`, `lane:vehicles=20,seen=2`, `random:12,seed=3`."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from coopenv.base.errors import UnknownEnvironmentError, listed, shown, suggest
from coopenv.scenario.scenes import layouts
from coopenv.scenario.scenes.layouts import Placed

MOST_VEHICLES = 64
"""Identities fit the 64 bits in which messages of `robust` say on whom they depend."""


class Option(NamedTuple):
    """A whole number that a scene takes."""

    least: int
    most: int
    default: int


class Scene(NamedTuple):
    """A kind of scene."""

    about: str
    build: Callable[..., Sequence[Placed]]
    """Takes the options by name."""
    options: Mapping[str, Option]


def _vehicles(default: int, least: int = 2) -> Option:
    return Option(least, MOST_VEHICLES, default)


_SEEN = Option(1, 8, 3)

SCENES: Mapping[str, Scene] = {
    "lane": Scene(
        "A lane, each measures those in front.",
        layouts.lane,
        {"vehicles": _vehicles(8), "seen": _SEEN},
    ),
    "roots": Scene(
        "Two streets that measure across.",
        layouts.roots,
        {"vehicles": _vehicles(10, 3)},
    ),
    "tree": Scene(
        "A tree, each measures those above.",
        layouts.tree,
        {"vehicles": _vehicles(15), "seen": _SEEN},
    ),
    "random": Scene(
        "A random acyclic graph.",
        layouts.random_graph,
        {"vehicles": _vehicles(12), "seen": _SEEN, "seed": Option(0, 2**31 - 1, 0)},
    ),
    "ring": Scene(
        "A circle, each measures those in front.",
        layouts.ring,
        {"vehicles": _vehicles(5, 3), "seen": Option(1, 2, 1)},
    ),
}
"""By name."""


class Request(NamedTuple):
    """A scene with every option."""

    name: str
    """As it was asked for."""
    kind: str
    options: Mapping[str, int]

    @property
    def vehicles(self) -> Sequence[Placed]:
        """Its vehicles in order."""
        return SCENES[self.kind].build(**self.options)


def scene_rows() -> list[dict[str, str]]:
    """Return what `list scenes` says of every kind."""
    return [
        {"name": f"{kind}:N", "options": ", ".join(map(_briefly, scene.options.items())), "about": scene.about}
        for kind, scene in SCENES.items()
    ]


def _briefly(option: tuple[str, Option]) -> str:
    name, (least, most, _) = option
    return f"{least}..{most} {name}" if most < 1000 else name


def read_request(text: str) -> Request:
    """Return what a name asks for; what it does not say is as usual.

    Raises:
        UnknownEnvironmentError: no such scene or option, or a number that is not allowed.
    """
    kind, _, rest = text.partition(":")
    if kind not in SCENES:
        raise UnknownEnvironmentError(f"unknown scene {shown(kind)}{suggest(kind, SCENES)}; known: {listed([*SCENES])}")
    known, given = SCENES[kind].options, {}
    for place, word in enumerate(rest.split(",") if rest.strip() else ()):
        key, equals, value = (part.strip() for part in word.partition("="))
        if not equals and place == 0:
            key, value = "vehicles", key  # lane:20
        if key not in known:
            allowed = ", ".join(f"{name} ({o.least}..{o.most})" for name, o in known.items())
            raise UnknownEnvironmentError(f"scene {kind}: unknown option {shown(key)}; allowed: {allowed}")
        if key in given:
            raise UnknownEnvironmentError(f"scene {kind}: {key} is given twice")
        given[key] = _number(kind, key, value, known[key])
    return Request(text, kind, {name: given.get(name, option.default) for name, option in known.items()})


def _number(kind: str, key: str, text: str, option: Option) -> int:
    whole = text.isascii() and text.isdigit() and len(text) < 12
    if not whole or not option.least <= int(text) <= option.most:
        raise UnknownEnvironmentError(
            f"scene {kind}: {key} = {shown(text)}, allowed are whole numbers {option.least} to {option.most}"
        )
    return int(text)
