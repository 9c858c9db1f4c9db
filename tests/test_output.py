"""Output that nobody reads or no disk takes: one line and a status, never a traceback."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.helpers.processes import COOPENV, DEADLOCK, start


@pytest.mark.parametrize("arguments", [["list"], ["schema"], ["--help"]])
def test_a_full_disk_is_one_line(arguments: list[str], tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        process = start((*COOPENV, *arguments), tmp_path, stdout=full)
        _, errors = process.communicate(timeout=DEADLOCK)
    assert (errors, process.returncode) == ("error: standard output: No space left on device\n", 2)


@pytest.mark.parametrize("arguments", [["list"], ["schema"], ["--version"]])
def test_a_closed_pipe_is_quiet(arguments: list[str], tmp_path: Path) -> None:
    reader = start(("true",), tmp_path, stdin=subprocess.PIPE)
    reader.wait()
    process = start((*COOPENV, *arguments), tmp_path, stdout=reader.stdin)
    _, errors = process.communicate(timeout=DEADLOCK)
    assert (errors, process.returncode) == ("", 141)


def test_results_are_kept_when_the_table_cannot_be_printed(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        command = (*COOPENV, "run", "overtaking", "--steps", "1", "--no-figures", "--out", "x")
        process = start(command, tmp_path, stdout=full)
        process.communicate(timeout=DEADLOCK)
    assert process.returncode == 2
    assert (tmp_path / "x" / "metrics.json").is_file()


def test_without_any_standard_stream(tmp_path: Path) -> None:
    closed = ("bash", "-c", 'exec "$@" <&- >&- 2>&-', "bash")
    for arguments, status in ((["list"], 0), (["nothing"], 2), (["schema", "--out", "s.json"], 0)):
        assert start((*closed, *COOPENV, *arguments), tmp_path).wait(DEADLOCK) == status
    assert (tmp_path / "s.json").read_text().startswith("{")


def test_a_full_disk_for_errors_changes_no_status(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        assert start((*COOPENV, "run", "nowhere"), tmp_path, stderr=full).wait(DEADLOCK) == 2


def test_names_that_are_no_text_are_printed(tmp_path: Path) -> None:
    strict = ("env", "PYTHONIOENCODING=ascii:strict")
    process = start((*strict, *COOPENV, "schema", "--out", "none\udcff/s.json"), tmp_path)
    _, errors = process.communicate(timeout=DEADLOCK)
    assert process.returncode == 2
    assert errors == "error: cannot write to none\\udcff/s.json: folder none\\udcff does not exist\n"


def test_a_terminal_without_width_still_shows_tables(tmp_path: Path) -> None:
    process = start(("env", "COLUMNS=0", *COOPENV, "list"), tmp_path)
    out, _ = process.communicate(timeout=DEADLOCK)
    assert "busy_intersection" in out
