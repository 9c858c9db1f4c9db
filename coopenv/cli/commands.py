"""Commands as functions of records of options, groups of commands, and the command line of a record."""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import fields
from enum import Enum
from typing import Any, TypeVar, get_type_hints

import typer
from typer.core import TyperGroup

from coopenv.base.errors import CoopenvError, listed, shown, suggest
from coopenv.base.installation import list_envs

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

    In the help, and in `command_text`, a record's own options come before those that it inherits.
    """
    [record] = [kind for name, kind in get_type_hints(function).items() if name != "return"]
    kinds, parameters = get_type_hints(record, include_extras=True), inspect.signature(record).parameters.values()

    def run(**given: Any) -> None:
        function(record(**given))

    run.__name__, run.__doc__ = function.__name__, function.__doc__
    run.__signature__ = inspect.Signature([p.replace(annotation=kinds[p.name]) for p in own_first(record, parameters)])  # type: ignore[attr-defined]
    return run


def own_first(record: type, members: Iterable[Any]) -> list[Any]:
    """Return fields or parameters of a record of options, its own before those that it inherits."""
    own = [vars(kind).get("__annotations__", {}) for kind in record.__mro__]
    return sorted(members, key=lambda one: next(depth for depth, names in enumerate(own) if one.name in names))


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
    for field in own_first(type(given), fields(given)):
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
