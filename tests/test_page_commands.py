"""Commands that the pages show are understood: their names, options and kinds of values; what they do is not run."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import app

ROOT = Path(__file__).resolve().parents[1]
COMMAND: Any = typer.main.get_command(app)
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(ROOT.glob("agents/*.md")), *sorted(ROOT.glob("docs/**/*.md"))]
FENCE = re.compile(r"^ *```(\w*)[^\n]*\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
OTHER_LANGUAGES = {"python", "toml", "text", "bibtex", "json"}
OUTPUT = re.compile(r"coopenv +(\(|\d)")
"""Lines of benchmarks' tables that begin with the project's name."""


def commands(page: Path) -> Iterator[list[str]]:
    """Yield the words after `coopenv` of every command in a page's blocks."""
    for language, body in FENCE.findall(page.read_text(encoding="utf-8")):
        for line in body.replace("\\\n", " ").splitlines() if language not in OTHER_LANGUAGES else ():
            if line.strip().startswith("coopenv ") and not OUTPUT.match(line.strip()):
                yield shlex.split(line, comments=True)[1:]


def understand(words: list[str]) -> None:
    """Read a command's words as the command line does. Raises typer's error where it does not know one."""
    name, command = "coopenv", COMMAND
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        assert words[0] in command.commands, f"no command {words[0]}"
        name, words, command = words[0], words[1:], command.commands[words[0]]
    if words != ["--install-completion"]:  # which is done while words are read
        with suppress(CoopenvError):  # names and files of the reader, such as `my_driver`, are looked up at once
            command.make_context(name, words)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_are_understood(page: Path) -> None:
    for words in commands(page):
        understand(list(words))


def test_mistakes_are_noticed() -> None:
    with pytest.raises(AssertionError, match="no command runn"):
        understand(["runn", "crossing_path"])
    for words in (["run", "crossing_path", "--sed", "3"], ["run"], ["run", "crossing_path", "--seed", "three"]):
        with pytest.raises(typer.BadParameter.__base__):  # type: ignore[arg-type]
            understand(words)


def test_commands_are_found() -> None:
    assert sum(1 for page in PAGES for _ in commands(page)) > 100
