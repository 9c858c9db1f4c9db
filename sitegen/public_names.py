"""Public names with signatures: `python -m sitegen.public_names` (`make names`) writes `tests/public_names.txt`.

Public are the names of the package, those that the pages of the Python API show, the commands with their options, and
the ids of the environments. The keys of scenarios are those of `docs/scenario.schema.json`.
"""

import re
from collections.abc import Iterator
from typing import Any

import griffe
import typer

from coopenv.base.installation import environment_id, list_envs
from coopenv.cli.app import app
from sitegen.mirror import ROOT

FILE = ROOT / "tests" / "public_names.txt"
PAGES = ROOT / "docs" / "reference" / "api"


def _public(item: Any) -> list[Any]:
    """Return the public members of a module or class that it defines itself, by name."""
    members = [member for name, member in item.members.items() if not member.is_alias and not name.startswith("_")]
    return sorted(members, key=lambda member: str(member.name))


def described(name: str, item: Any) -> Iterator[str]:
    """Yield a line for a name, and those of the members of a class or module."""
    if item.is_function:
        yield item.signature(name=name)
    elif item.is_attribute:
        yield name if item.annotation is None else f"{name}: {item.annotation}"
    else:
        if item.is_class:
            bases = ", ".join(str(base) for base in item.bases)
            start = item.members.get("__init__")
            made = start and start.signature(name=f"class {name}", return_type=False)
            yield made or f"class {name}({bases})"
        for member in _public(item):
            yield from described(f"{name}.{member.name}", member)


def _python() -> Iterator[str]:
    """Yield the names of the package and of the pages of its API."""
    loader = griffe.GriffeLoader(search_paths=[str(ROOT)])
    package: Any = loader.load("coopenv")
    loader.resolve_aliases()
    short = {}
    for name in sorted(map(str, package.exports or ())):
        if name in package.members:
            item = package.members[name]
            short[item.canonical_path] = name
            yield from described(f"coopenv.{name}", item.final_target if item.is_alias else item)
    for page in sorted(PAGES.glob("*.md")):
        for path in re.findall(r"^::: (coopenv\.\S+)", page.read_text(encoding="utf-8"), re.MULTILINE):
            if path not in short:
                yield from described(path, package[path.removeprefix("coopenv.")])


def _commands(name: str, command: Any) -> Iterator[str]:
    """Yield a line for every command, with its arguments and options."""
    for part in sorted(getattr(command, "commands", {})):
        yield from _commands(f"{name} {part}", command.commands[part])
    if not hasattr(command, "commands"):
        words = [word for option in command.params for word in option.opts if word.startswith("--") or len(word) > 2]
        yield " ".join([name, *sorted(words)])


def report() -> str:
    """Return the text of the file: one name a line, each once."""
    commands = _commands("$ coopenv", typer.main.get_command(app))
    lines = [*_python(), *commands, *map(environment_id, [*list_envs(), "scenario"])]
    return "\n".join(dict.fromkeys(" ".join(line.split()) for line in lines)) + "\n"


if __name__ == "__main__":
    FILE.write_text(report(), encoding="utf-8")
    print(FILE)
