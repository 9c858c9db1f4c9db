"""Commands of other packages: listed, run by name, and one line where one is broken."""

from __future__ import annotations

from pathlib import Path

import pytest

from coopenv.cli.app import main
from tests.helpers.plugins import install

GREETER = """
import typer

several = typer.Typer(help="Several greetings.")


@several.command()
def hello() -> None:
    print("hello")


@several.command()
def bye() -> None:
    print("bye")


def greet(name: str, loud: bool = False) -> None:
    \"\"\"Greet a vehicle.\"\"\"
    print(f"hello {name}{'!' * loud}")


WRONG = 3
"""
POINTS = {"greet": "greeter:greet", "several": "greeter:several", "wrong": "greeter:WRONG", "absent": "no_such_one:run"}


@pytest.fixture(autouse=True)
def greeter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another package with commands."""
    install(tmp_path, monkeypatch, "greeter", GREETER, {"coopenv.commands": {**POINTS, "run": "greeter:greet"}})


def test_commands_of_another_package_are_listed_and_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["greet", "vehicle_1", "--loud"]) == 0
    assert main(["several", "bye"]) == 0
    assert capsys.readouterr().out == "hello vehicle_1!\nbye\n"
    assert main(["--help"]) == 0
    listed = capsys.readouterr().out
    assert "Greet a vehicle." in listed and "Greeter:" in listed and "Several greetings." in listed
    assert "no_such_one" in listed, "why it cannot be run"
    assert "  run      Run an environment" in listed, "a command of coopenv keeps its name"


@pytest.mark.parametrize(
    ("command", "why"),
    [
        ("absent", "error: command 'absent' (no_such_one:run) cannot be loaded: ModuleNotFoundError"),
        ("wrong", "error: command 'wrong': expected a function or a typer.Typer, got 3"),
        ("gret", "error: no such command: 'gret' (did you mean 'greet'?); known: list, "),
    ],
)
def test_a_broken_command_is_one_line(command: str, why: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(why) and printed.err.count("\n") == 1 and not printed.out
