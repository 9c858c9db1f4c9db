"""Output of commands and parts of tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from typing import Any

from rich.console import Console

from coopenv.cli.app import main


def refused(*arguments: str, command: Callable[[Sequence[str]], int] = main) -> str:
    """Run a command that refuses its input, and return the one line that it prints."""
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        assert command(arguments) == 2
    error = err.getvalue()
    assert out.getvalue() == "" and error.startswith("error: ") and error.count("\n") == 1, error
    return error


def printed(*parts: Any, width: int = 80) -> str:
    """Return what a console prints of tables and texts."""
    text = StringIO()
    console = Console(file=text, width=width, markup=False, highlight=False, emoji=False)
    for part in parts:
        console.print(part)
    return text.getvalue()
