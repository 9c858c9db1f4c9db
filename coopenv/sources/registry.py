"""The table of sources: kinds of names that give ticks, of this package, of its guests and of installed packages.

A package offers its own kind under the entry point group `coopenv.sources`, as a `SourceKind`. A name is looked up in
the table before any of the simulation is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coopenv.base.errors import CoopenvError, check_one_of, shown
from coopenv.base.installation import is_scene, list_envs
from coopenv.base.plugins import call, loaded, offered

if TYPE_CHECKING:
    from coopenv.observers.recording import Recording
    from coopenv.scenario import ScenarioLike
    from coopenv.sources.base import Backend
    from coopenv.sources.selection import Selection

GROUP = "coopenv.sources"

LOG_SUFFIX = ".mcap"


@dataclass(frozen=True, kw_only=True)
class SourceKind:
    """A kind of source; places are `module:name` and load on first use."""

    title: str
    """Continues the sentence "NAME is ..."."""
    opener: str = ""
    """Function of a name and overrides, and of the `options` by name, that returns the backend."""
    claims: Callable[[str, str | Path | None], bool] | None = None
    """Whether a name, with this map of topics, is of the kind; None: the name of the entry point, also NAME:DETAILS."""
    options: tuple[str, ...] = ()
    """Arguments of `open_backend` that the opener takes, `selection` among them; others are refused."""
    recorded: bool = False
    """True if its ticks are recorded; otherwise the name of the entry point is one for the option `backend`, too."""
    reader: str = ""
    """Function of a name, the folder `data` and a `variant` that returns a `Recording`; empty: it gives only ticks."""
    conversion: str = "coopenv record"
    """Command that makes a recording of a name, where there is no reader."""
    example: str = ""
    """Names for which the reader is."""
    comparison: str = ""
    """Its `coopenv.bench.observers.sources.RecordSource`, made of name, `data` and selection; empty: the usual one."""
    variants: Mapping[str, str] = field(default_factory=dict)
    """Variants of its records by name, each with its meaning; empty: those with faults."""
    caveat: str = ""
    """Note below tables of its records."""
    writers: Mapping[str, str] = field(default_factory=dict)
    """Functions of a `Recording`, a path and an observer's name (None: no estimates) that write it, by format."""
    simulation: str = ""
    """Backend, made of the scenario, of environments whose key `sensing` is the name of the entry point."""

    def open(
        self, name: ScenarioLike, overrides: Mapping[str, Any], given: Mapping[str, Any], selection: Selection
    ) -> Backend:
        """Return the backend of a name; options are `given` by name.

        Raises:
            CoopenvError: an option is not for this kind, or it cannot be opened.
        """
        options = {**given, **({"selection": selection} if selection.given else {})}
        for option in [option for option in options if option not in self.options]:
            first = next(iter(selection.given)) if option == "selection" else option
            raise CoopenvError(f"{first} is for {self._readers(option)}, '{name}' is {self.title}")
        backend: Backend = call(self.opener, name, overrides, **options)
        return backend

    def _readers(self, option: str) -> str:
        if option in ("data", "variant", "selection"):
            return "recorded data" if option == "selection" or not self.recorded else "recorded data sets"
        if option == "topics":
            return "ROS bags"
        return " or ".join(f"backend='{name}'" for name, kind in kinds().items() if option in kind.options)


LOG = SourceKind(
    title="an MCAP file",
    opener="coopenv.sources.sources:replay_of",
    claims=lambda name, topics: name.endswith(LOG_SUFFIX),
    options=("data", "variant", "selection"),
    recorded=True,
    reader="coopenv.sources.sources:read_log",
    example=f"FILE{LOG_SUFFIX}",
)
ENVIRONMENT = SourceKind(title="simulated", opener="coopenv.sources.sources:open_environment", options=("backend",))
"""Whatever no other kind claims: an environment by name, file, scene or dict."""


def no_name(name: str, topics: str | Path | None) -> bool:
    """Claim no name: the kind is opened with the option `backend` only."""
    return False


def kinds(asked: str = "") -> dict[str, SourceKind]:
    """Return the kinds of guests and installed packages by name, without those that cannot be loaded.

    Raises:
        CoopenvError: the one that is asked for cannot be loaded.
    """
    found = {}
    for name, point in offered(GROUP).items():
        try:
            found[name] = loaded(point, "source")
            if not isinstance(found[name], SourceKind):
                raise CoopenvError(
                    f"source '{name}' ({point.value}): expected a SourceKind, got {shown(found.pop(name))}"
                )
        except CoopenvError:
            if name == asked:
                raise
    return found


def write_as(form: str, recording: Recording, path: Path, observer: str | None) -> None:
    """Write a recording in a format of `SourceKind.writers`. Raises CoopenvError: it cannot be written."""
    call(next(kind.writers[form] for kind in kinds().values() if form in kind.writers), recording, path, observer)


def watched() -> list[str]:
    """Return the names of kinds with the option `watch`, whose vehicles `coopenv view` observes and never drives."""
    return [name for name, kind in kinds().items() if "watch" in kind.options]


def live_kind(name: str, others: Mapping[str, SourceKind]) -> SourceKind:
    """Return the kind that a name of the option `backend` denotes, one of the others included.

    Raises:
        CoopenvError: there is none, or it cannot be loaded.
    """
    live = {entry: kind for entry, kind in kinds(name).items() if kind.opener and not kind.recorded}
    known = {**others, **live, **others}
    check_one_of("unknown backend", name, known)
    return known[name]


def kind_of(name: ScenarioLike | Recording, topics: str | Path | None = None) -> SourceKind:
    """Return the kind of source of a name, which need not exist; `topics` is the map of a bag's topics.

    A folder that is called like an environment is ./NAME, unless a map is given.

    Raises:
        CoopenvError: it is the name of a kind that cannot be loaded.
    """
    text = str(name)
    if not isinstance(name, str | Path) or (topics is None and (text in list_envs() or is_scene(text))):
        return ENVIRONMENT
    first = text.partition(":")[0]
    for entry, kind in {**kinds(first), "": LOG}.items():
        with suppress(Exception):  # of another package's code: names of other kinds are not affected
            if kind.claims(text, topics) if kind.claims else entry == first:
                return kind
    return ENVIRONMENT
