"""Options that several commands share, and what they are read into."""

from __future__ import annotations

import os
import sys
import tomllib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coopenv.base.errors import CoopenvError, DataWarning, ScenarioWarning
from coopenv.cli import complete

if TYPE_CHECKING:
    from rich.console import Console

    from coopenv.backends.base import Backend

MOST_WORLDS = 1_000_000
"""Of a command that drives them all at once."""

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
_source = partial(typer.Argument, **complete.ENVIRONMENT)
Environment = Annotated[
    str,
    _source(metavar="ENV", help="Name of an environment (see `coopenv list`), a scene (lane:20) or a TOML file."),
]
_SOURCES = "Environment (name or TOML file), recorded robots (mrclam_1 .. mrclam_9), a log file or a ROS bag."
Source = Annotated[str, _source(metavar="ENV|DATASET|FILE.mcap|BAG", help=_SOURCES)]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a dotted key of the scenario, e.g. noise.enabled=false. The value is TOML, or else a string. "
        "Repeatable.",
        autocompletion=complete.override_keys,
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the random generator.")]
PolicyName = Annotated[
    str,
    typer.Option(
        "--policy",
        help="Policy of the driven vehicles: zero, random, the name of an agent, its folder, or where its class "
        "stands, mine.py:Mine or package.module:Mine.",
        **complete.POLICY,
    ),
]
DataFolder = Annotated[
    Path | None, typer.Option("--data", help="Folder of recorded data sets (default: the variable COOPENV_DATA).")
]
Variant = Annotated[
    str | None, typer.Option("--variant", help="Variant of a data set: landmarks, landmarks+robots or blind.")
]
TopicMap = Annotated[
    Path | None, typer.Option("--map", help="TOML file that says what the topics of a ROS bag are (docs/bags.md).")
]
Connect = Annotated[
    str | None,
    typer.Option(help="Endpoint of the network in place of the deployment's network.connect.", show_default=False),
]
GateConnect = Annotated[
    str | None,
    typer.Option(
        help="Router on the car, that of its zenoh-bridge-ros2dds, in place of the deployment's gate.connect "
        "[default: tcp/127.0.0.1:7447].",
        show_default=False,
    ),
]
OffBoard = Annotated[
    bool,
    typer.Option("--off-board", help="Allow a router that is not on this computer, for trials beside a car."),
]
Station = Annotated[
    str | None,
    typer.Option(
        help="Whose commands count [default: the deployment's security.identity, or station]; that is the car itself "
        "where it is driven by `coopenv svea run --car`.",
        show_default=False,
    ),
]
LogObserver = Annotated[
    str | None,
    typer.Option(
        "--observer",
        help="Whose estimates are shown: a name, or mine.py:Mine (default: the scenario's own).",
        **complete.OBSERVERS,
        show_default=False,
    ),
]
LogScene = Annotated[
    bool,
    typer.Option("--scene/--no-scene", help="Also write what Foxglove and Lichtblick show: scene, cameras, estimates."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")]
SteadyFrom = Annotated[
    float | None,
    typer.Option(help="Start of the steady state in s (default: 70 % of the horizon).", show_default=False),
]


def console(stderr: bool = False) -> Console:
    """Return a console that prints scenario texts as they are."""
    from rich.console import Console

    made = Console(stderr=stderr, markup=False, highlight=False, emoji=False)
    if made.width < 1:  # COLUMNS=0
        made.width = 80
    return made


def print_json(result: Any) -> None:
    """Print a result as JSON."""
    from coopenv.base.format import json_text

    sys.stdout.write(json_text(result))


def show(path: Path) -> None:
    """Open a result with the program that the system has for it, or say that there is none."""
    if not has_display():
        print(f"note: there is no display to show {path} on", file=sys.stderr)
    elif typer.launch(str(path)) != 0:
        print(f"note: there is no program to open {path}", file=sys.stderr)


def show_page(address: Path | str) -> None:
    """Open a page in the user's browser, or say that there is none; where there is no display nothing happens."""
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
    """Return the scenario of a simulation, its warnings printed as one line each."""
    from coopenv.backends.sources import open_simulation

    with warned():
        return open_simulation(environment, overrides)


def open_source(
    environment: str, overrides: dict[str, Any], data: Path | None, variant: str | None, topics: Path | None = None
) -> Backend:
    """Return where the ticks of an environment or a recording come from, warnings printed as one line each."""
    from coopenv.backends.sources import open_backend

    with warned():
        return open_backend(environment, None, overrides, data, variant, topics=topics)


@contextmanager
def warned() -> Iterator[None]:
    """Print the warnings of scenarios and data that are loaded meanwhile as one line each."""
    ours = (ScenarioWarning, DataWarning)
    with warnings.catch_warnings(record=True) as caught:
        for category in ours:
            warnings.simplefilter("always", category)
        yield
    for warning in caught:
        if issubclass(warning.category, ours):
            print(f"warning: {warning.message}", file=sys.stderr)


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
            raise CoopenvError(f"--set {assignment}: expected KEY=VALUE, e.g. --set noise.enabled=false")
        overrides[key] = parse_value(text)
    return overrides


def parse_value(text: str) -> Any:
    """Return a TOML value, or the text itself when it is none."""
    try:
        document = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):  # too many digits or brackets, too
        return text
    return document["value"] if len(document) == 1 else text
