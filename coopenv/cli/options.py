"""Options that several commands share, and their records."""

from __future__ import annotations

import inspect
import os
import shlex
import sys
import tomllib
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from enum import Enum, StrEnum
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperGroup

from coopenv.base.errors import (
    MAX_MESSAGE,
    AgentWarning,
    CoopenvError,
    DataWarning,
    ScenarioWarning,
    listed,
    printable,
    shortened,
    shown,
    suggest,
)
from coopenv.base.installation import BAGS, SCENES, is_scene, list_agents, list_envs, scenario_path

if TYPE_CHECKING:
    from rich.console import Console

    from coopenv.sources.base import Backend
    from coopenv.sources.selection import Selection

PLAIN = ("zero", "random")
"""Policies without an agent."""


def completion(names: Callable[[], Iterable[str]], several: bool = False) -> Callable[[str], list[str]]:
    """Return the shell's completion of a name; `several`: of a list of names with commas between."""

    def complete(incomplete: str) -> list[str]:
        done, comma, last = incomplete.rpartition(",") if several else ("", "", incomplete)
        left = (name for name in names() if not (several and name in done.split(",")))
        return [f"{done}{comma}{name}" for name in left if name.startswith(last)]

    return complete


def late(place: str) -> Callable[..., Any]:
    """Return a function, `module:name`, whose module is loaded by the first call."""
    return lambda *arguments: resolve_name(place)(*arguments)


observer_names = late("coopenv.observers.registry:list_observers")
check_agent = late("coopenv.policies.loader:check_agent")
check_observer = late("coopenv.observers.registry:check_known")
environments = completion(lambda: [*list_envs(), *(f"{kind}:" for kind in SCENES)])  # the shell completes files itself
agents, agent_lists = completion(list_agents), completion(list_agents, several=True)
policies, policy_lists = (completion(lambda: [*PLAIN, *list_agents()], several) for several in (False, True))
observers = completion(observer_names, several=True)
override_keys = completion(lambda: (f"{key}=" for key in dotted_keys(resolve_name("coopenv.scenario:Scenario"))))


def existing(what: str) -> Callable[[Any], Any]:
    """Return the check that a path, or each of several, exists; `what` it is called."""

    def check(given: Any) -> Any:
        for path in given if isinstance(given, list) else [given]:
            if path is not None and not os.path.exists(path):  # noqa: PTH110 (never raises)
                raise CoopenvError(f"no such {what}: {path}")
        return given

    return check


def known_environment(name: str | None) -> str | None:
    """Return the name of an environment, a file or a recording. Raises CoopenvError: there is none."""
    from coopenv.sources.registry import ENVIRONMENT, LOG_SUFFIX, kind_of

    if name is not None and name.endswith((*BAGS, LOG_SUFFIX)):
        existing("log" if name.endswith(LOG_SUFFIX) else "bag")(name)
    if name is not None and not os.path.exists(name) and kind_of(name) is ENVIRONMENT and not is_scene(name):  # noqa: PTH110 (never raises)
        for kind, names in (("agent", list_agents()), ("observer", observer_names())):
            if name in names:
                raise CoopenvError(f"expected an environment, {name} is an {kind}: coopenv list, coopenv list {kind}s")
        scenario_path(name)
    return name


def known_source(name: str) -> str | None:
    """Return the name of what can be shown, an episode's `.npz` included; errors as for `known_environment`."""
    return name if name.endswith(".npz") else known_environment(name)


def known_policy(name: str | None) -> str | None:
    """Return the name of a policy, a folder or a place in code. Raises CoopenvError: there is no such policy."""
    if name is not None and name not in PLAIN:
        check_agent(name, "policy", PLAIN)
    return name


def each(check: Callable[[str], object]) -> Callable[[Any], Any]:
    """Return the check of several names, a list or a text with commas between, each by a check."""

    def checked(names: Any) -> Any:
        for name in names if isinstance(names, list) else words(names):
            check(name)
        return names

    return checked


known_environments, known_agents = each(known_environment), each(check_agent)


def words(text: str | None) -> list[str]:
    """Return the parts between commas."""
    return [word.strip() for word in (text or "").split(",") if word.strip()]


ENVIRONMENT: dict[str, Any] = {"autocompletion": environments, "callback": known_environment}
POLICY: dict[str, Any] = {"autocompletion": policies, "callback": known_policy}
POLICIES: dict[str, Any] = {"autocompletion": policy_lists, "callback": each(known_policy)}
AGENT: dict[str, Any] = {"autocompletion": agents, "callback": known_agents}
AGENTS: dict[str, Any] = {"autocompletion": agent_lists, "callback": known_agents}
OBSERVERS: dict[str, Any] = {"autocompletion": observers, "callback": each(check_observer)}
"""Completion and check of an argument or option."""


def dotted_keys(annotation: Any) -> Iterator[str]:
    """Yield the dotted key of every setting below a pydantic model, or below those of a type; `*`: any entry."""
    if hasattr(annotation, "model_fields"):
        for name, info in annotation.model_fields.items():
            parts = list(dict.fromkeys(dotted_keys(info.annotation)))
            yield from (f"{name}.{key}" for key in parts) if parts else [name]
        return
    entries = "*." if get_origin(annotation) in (list, tuple, dict) else ""
    for argument in get_args(annotation):
        yield from (f"{entries}{key}" for key in dotted_keys(argument))


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


Options = TypeVar("Options")


class Grouped(TyperGroup):
    """Lists its commands by the group that each names as its `rich_help_panel`, with whole sentences."""

    def resolve_command(self, ctx: typer.Context, args: list[str]) -> Any:  # type: ignore[override]
        """Return the command that the arguments begin with."""
        name = args[0]
        if self.get_command(ctx, name) is None:
            known = self.list_commands(ctx)
            runs = f"; an environment runs with: coopenv run {name}" if name in list_envs() else ""
            options = [option for parameter in self.get_params(ctx) for option in parameter.opts]
            near = f" (did you mean '--{name}'?)" if f"--{name}" in options else suggest(name, known)
            raise CoopenvError(f"no such command: {shown(name)}{near}; known: {listed(known, 40)}{runs}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: typer.Context, formatter: Any) -> None:  # type: ignore[override]
        """Write the list."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for name, one in self.commands.items():
            panel = getattr(one, "rich_help_panel", None) or "Commands"
            if not one.hidden:
                groups.setdefault(panel, []).append((name, one.get_short_help_str(formatter.width * 10)))
        for panel, rows in groups.items():
            with formatter.section(panel):
                formatter.write_dl(rows, col_max=12)


def usage_hint(error: Any) -> str:
    """Return the hint after the error of an unknown option or argument; else an empty text."""
    name, context = str(getattr(error, "option_name", "")), error.ctx
    if context is None or not (name or type(error) is typer.BadParameter.__base__):
        return ""
    if "--override" in [option for parameter in context.command.params for option in parameter.opts]:
        from coopenv.scenario import Scenario

        given = name or error.format_message().rpartition("(")[2]
        key = given.lstrip("-").partition("=")[0].replace("-", "_")
        if key.partition(".")[0] in Scenario.model_fields:
            return f"; a key of the scenario: --override {key}=VALUE"
    return f"; see {context.command_path} --help"


def print_help(context: typer.Context) -> None:
    """Print the help of a group of which no command is named."""
    if context.invoked_subcommand is None:
        print(context.get_help())


def group(words: str) -> typer.Typer:
    """Return a group of commands, which is described in some words."""
    look: dict[str, Any] = {"cls": Grouped, "rich_markup_mode": None}
    return typer.Typer(help=words, invoke_without_command=True, callback=print_help, **look)


def command(function: Callable[[Options], None]) -> Callable[..., None]:
    """Return a command whose parameters are the fields of a record of options, the only argument of the function.

    In the help a record's own options come before those that it inherits.
    """
    [record] = [kind for name, kind in get_type_hints(function).items() if name != "return"]
    kinds = get_type_hints(record, include_extras=True)
    own = [vars(kind).get("__annotations__", {}) for kind in record.__mro__]
    parameters = inspect.signature(record).parameters.values()
    own_first = sorted(parameters, key=lambda p: next(depth for depth, names in enumerate(own) if p.name in names))

    def run(**given: Any) -> None:
        function(record(**given))

    run.__name__, run.__doc__ = function.__name__, function.__doc__
    run.__signature__ = inspect.Signature([p.replace(annotation=kinds[p.name]) for p in own_first])  # type: ignore[attr-defined]
    return run


def command_text(words: str, given: Any, leave_out: Collection[str] = ()) -> str:
    """Return the command line that gives a record of options again, for a shell.

    Options that are 0, off or absent by default are left out; other defaults are written, because they may change.

    Args:
        words: the command, such as "bench observers".
        given: the record, a dataclass.
        leave_out: names of fields that do not change the result.
    """
    arguments, named = [], []
    kinds = get_type_hints(type(given), include_extras=True)
    for field in fields(given):
        value = getattr(given, field.name)
        if field.name in leave_out or (not value and value == field.default):
            continue
        texts = [
            str(one.value if isinstance(one, Enum) else one) for one in (value if isinstance(value, list) else [value])
        ]
        if not (name := _option(field.name, kinds)):
            arguments += texts
        for text in texts if name else ():
            named += [name] if value is True else [name.replace("--", "--no-", 1)] if value is False else [name, text]
    return shlex.join(["coopenv", *words.split(), *arguments, *named])


def _option(field: str, kinds: Mapping[str, Any]) -> str:
    """Return the option of a field of a record, from the fields' types; empty: it is an argument."""
    option = next(part for part in kinds[field].__metadata__ if hasattr(part, "param_decls"))
    if isinstance(option, typer.models.ArgumentInfo):
        return ""
    name = next((w for w in (option.default, *(option.param_decls or ())) if str(w).startswith("--")), "")
    return name.partition("/")[0] or f"--{field.replace('_', '-')}"


def refuse(given: Any, names: Collection[str], reason: str) -> None:
    """Refuse the fields of a record of options that differ from their defaults. Raises CoopenvError: one does."""
    for field in fields(given):
        if field.name in names and getattr(given, field.name) != field.default:
            option = _option(field.name, get_type_hints(type(given), include_extras=True))
            raise CoopenvError(f"{option}: {reason}")


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """Source to simulate, replay or read."""

    environment: Source
    overrides: Overrides = None
    data: DataFolder = None
    variant: Variant = None
    topics: TopicMap = None
    start: From = None
    until: Until = None
    robots: Robots = None

    @property
    def selection(self) -> Selection:
        """The part of recorded data that is used."""
        from coopenv.sources.selection import Selection

        return Selection.of(self.start, self.until, self.robots)

    @property
    def files(self) -> dict[str, Any]:
        """Options of recorded data, as for `open_backend`."""
        return {"data": self.data, "variant": self.variant, "topics": self.topics}

    @property
    def changes(self) -> dict[str, Any]:
        """The overrides of the scenario, dotted key to value."""
        return parse_overrides(self.overrides)

    def open(self) -> Backend:
        """Return the source of ticks."""
        from coopenv.sources.sources import open_backend

        return open_backend(self.environment, None, self.changes, self.selection, **self.files)


def console(stderr: bool = False) -> Console:
    """Return a console that prints scenario texts as they are."""
    from coopenv.base.terminal import Terminal

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
