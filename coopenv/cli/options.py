"""Options that several commands share, and their records."""

from __future__ import annotations

import os
import sys
import tomllib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coopenv.base.errors import (
    MAX_MESSAGE,
    AgentWarning,
    CoopenvError,
    DataWarning,
    ScenarioWarning,
    printable,
    shortened,
)
from coopenv.cli.arguments import ENVIRONMENT, OBSERVERS, POLICY, override_keys

if TYPE_CHECKING:
    from rich.console import Console

    from coopenv.sources.base import Backend
    from coopenv.sources.selection import Selection


MOST_WORLDS = 1_000_000
"""Most worlds of a command that drives them all at once."""

FigureFormat = StrEnum("FigureFormat", "png pdf svg")
FigureColumn = StrEnum("FigureColumn", "ieee1 ieee2 springer1 springer2")
FigureWidth = Annotated[
    FigureColumn | None,
    typer.Option(
        "--width",
        help="Draw figures in the width and fonts of a journal's column: IEEE 3.5 or 7.16 in, Springer 84 or 174 mm "
        "(default: a page).",
        show_default=False,
    ),
]
_source = partial(typer.Argument, **ENVIRONMENT)
Environment = Annotated[
    str,
    _source(metavar="ENV", help="Name of an environment (see `coopenv list`), a scene (lane:20) or a TOML file."),
]
_SOURCES = "Environment (name or TOML file), recorded robots (mrclam_1 .. mrclam_9), a log file or a ROS bag."
Source = Annotated[str, _source(metavar="ENV|DATASET|FILE.mcap|BAG", help=_SOURCES)]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--override",
        "--set",
        metavar="KEY=VALUE",
        help="Override a dotted key of the scenario, e.g. noise.enabled=false. The value is TOML, or else a string. "
        "Repeatable.",
        autocompletion=override_keys,
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the random generator.")]
PolicyName = Annotated[
    str,
    typer.Option(
        "--policy",
        "--agent",
        help="Policy of the driven vehicles: zero, random, the name of an agent, its folder, or where its class "
        "stands, mine.py:Mine or package.module:Mine.",
        **POLICY,
    ),
]
DataFolder = Annotated[
    Path | None, typer.Option("--data", help="Folder of recorded data sets (default: the variable COOPENV_DATA).")
]
Variant = Annotated[
    str | None, typer.Option("--variant", help="Variant of a data set: landmarks, landmarks+robots or blind.")
]
From = Annotated[
    float | None, typer.Option("--from", help="Time at which the part of recorded data that is used begins, s.")
]
Until = Annotated[float | None, typer.Option("--until", help="Time at which it ends, s.")]
Robots = Annotated[
    str | None,
    typer.Option(
        "--robots",
        help="Recorded robots that are used, names or numbers with commas between, such as 1,3 (default: all).",
    ),
]
TopicMap = Annotated[
    Path | None, typer.Option("--map", help="TOML file with the map of a ROS bag's topics (docs/bags.md).")
]
Trust = Annotated[
    list[str] | None,
    typer.Option("--trust", help="Topic of a ROS bag that is used unchanged although other streams contradict; `all`."),
]
Connect = Annotated[
    str | None,
    typer.Option(help="Endpoint of the network in place of the deployment's network.connect.", show_default=False),
]
ObserverName = Annotated[
    str | None,
    typer.Option(
        help="Observer by name or as mine.py:Mine (default: that of the environment).",
        show_default=False,
        **OBSERVERS,
    ),
]
LogObserver = Annotated[
    str | None,
    typer.Option(
        "--observer",
        help="Observer of the estimates: a name, or mine.py:Mine (default: the scenario's own).",
        **OBSERVERS,
        show_default=False,
    ),
]
LogScene = Annotated[
    bool,
    typer.Option("--scene/--no-scene", help="Also write data for Foxglove and Lichtblick: scene, cameras, estimates."),
]
TextFile = Annotated[Path | None, typer.Option(help="File to write (default: standard output).")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")]
SteadyFrom = Annotated[
    float | None,
    typer.Option(help="Start of the steady state in s (default: 70 % of the horizon).", show_default=False),
]


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """Overrides of a scenario, and where and which part of recorded data is used."""

    overrides: Overrides = None
    data: DataFolder = None
    topics: TopicMap = None
    start: From = None
    until: Until = None
    robots: Robots = None
    trust: Trust = None

    @property
    def selection(self) -> Selection:
        """The part of recorded data that is used."""
        from coopenv.sources.selection import Selection

        return Selection.of(self.start, self.until, self.robots, self.trust or ())

    @property
    def changes(self) -> dict[str, Any]:
        """The overrides of the scenario, dotted key to value."""
        return parse_overrides(self.overrides)


@dataclass(frozen=True, kw_only=True)
class SourceOptions(DataOptions):
    """Source to simulate, replay or read."""

    environment: Source
    variant: Variant = None

    @property
    def files(self) -> dict[str, Any]:
        """Options of recorded data, as for `open_backend`."""
        return {"data": self.data, "variant": self.variant, "topics": self.topics}

    def open(self) -> Backend:
        """Return the source of ticks."""
        from coopenv.sources.sources import open_backend

        return open_backend(self.environment, None, self.changes, self.selection, **self.files)


def console(stderr: bool = False) -> Console:
    """Return a console that prints scenario texts as they are."""
    from coopenv.report.terminal import Terminal

    return Terminal(stderr=stderr)


def print_json(result: Any) -> None:
    """Print a result as JSON."""
    from coopenv.base.format import json_text

    sys.stdout.write(json_text(result))


def write_text(text: str, out: Path | None) -> None:
    """Write a text to a file, or to standard output without one."""
    from coopenv.base.files import replace_text

    if out is None:
        sys.stdout.write(text)
    else:
        replace_text(out, text)


def show(path: Path) -> None:
    """Open a result with the system's program for it, or print that there is none."""
    if not has_display():
        print(f"note: there is no display to show {path} on", file=sys.stderr)
    elif typer.launch(str(path)) != 0:
        print(f"note: there is no program to open {path}", file=sys.stderr)


def show_page(address: Path | str) -> None:
    """Open a page in the user's browser, or print that there is none; without a display nothing happens."""
    import webbrowser

    url = address if isinstance(address, str) else address.resolve().as_uri()
    if has_display() and not webbrowser.open(url):
        print(f"note: there is no browser to open {address}", file=sys.stderr)


def has_display() -> bool:
    """Return whether a browser would have a screen here."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def load(environment: str, overrides: dict[str, Any]) -> Any:
    """Return the scenario of a simulation."""
    from coopenv.sources.sources import open_simulation

    return open_simulation(environment, overrides)


MOST_WARNINGS = 20  # of a command; an observer may warn at each tick


@contextmanager
def warned() -> Iterator[None]:
    """Print each warning about scenarios, data and agents meanwhile once, as one line."""
    ours = (ScenarioWarning, DataWarning, AgentWarning)
    printed: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *where: Any) -> None:
        text = f"warning: {shortened(printable(str(message)), MAX_MESSAGE)}"
        if text in printed or len(printed) > MOST_WARNINGS:
            return
        printed.add(text)
        if len(printed) > MOST_WARNINGS:
            print("warning: further warnings are not printed", file=sys.stderr)
        elif issubclass(category, ours):
            print(text, file=sys.stderr)
        else:
            others(text.removeprefix("warning: "), category, *where)

    with warnings.catch_warnings():
        others, warnings.showwarning = warnings.showwarning, show  # type: ignore[assignment]
        for category in ours:
            warnings.simplefilter("always", category)
        yield


def parse_overrides(assignments: Sequence[str] | None) -> dict[str, Any]:
    """Return `key=value` texts as a dict; a value that is not TOML is a string.

    Raises:
        CoopenvError: no `=`, or nothing before it.
    """
    overrides = {}
    for assignment in assignments or ():
        key, equals, text = assignment.partition("=")
        key, text = key.strip(), text.strip()
        if not equals or not key:
            raise CoopenvError(f"--set or --override {assignment}: expected KEY=VALUE, e.g. noise.enabled=false")
        overrides[key] = parse_value(text)
    return overrides


def parse_value(text: str) -> Any:
    """Return a TOML value, or the text itself when it is none."""
    try:
        document = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):  # too many digits or brackets, too
        return text
    return document["value"] if len(document) == 1 else text
