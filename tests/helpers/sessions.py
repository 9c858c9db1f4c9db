"""Run a page of docs/ as its reader would: programs and commands from top to bottom, in one folder.

A block with a title is a file that the reader saves; `python` blocks run one after the other in one program, `bash`
blocks in a shell; a `text` block right after one of these is its output.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from io import StringIO
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
NEEDS = {"train": ("stable_baselines3", "train"), "logs": ("rosbags", "log"), "cars": ("zenoh", "svea")}
"""By tutorial a module and the extra that brings it."""


class Block(NamedTuple):
    """A block of code, and what the page says that it prints."""

    language: str
    file: str
    code: str
    output: str


def blocks(page: Path) -> Iterator[Block]:
    """Yield the blocks of a page that are run or saved."""
    text = page.read_text(encoding="utf-8")
    found = list(BLOCK.finditer(text))
    for match, after in zip_longest(found, found[1:]):
        language, file, code = match.groups()
        follows = after and after[1] == "text" and not text[match.end() : after.start()].strip()
        if language in ("python", "bash") or file:
            yield Block(language, file or "", code, after[3] if after and follows else "")


def prepare(tutorial: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip a tutorial whose extra is missing; give others the command."""
    if tutorial in NEEDS:
        module, extra = NEEDS[tutorial]
        pytest.importorskip(module, reason=f"needs the extra {extra!r}")
    tool = folder / "bin" / "coopenv"
    tool.parent.mkdir()
    tool.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m coopenv "$@"\n', encoding="utf-8")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tool.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def run_page(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run a page in a folder and return the names of its program."""
    prepare(page.stem, folder, monkeypatch)
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    program: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks(page):
        if block.file:
            (folder / block.file).write_text(block.code, encoding="utf-8")
        elif block.language == "bash":
            done = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", block.code],
                cwd=folder,
                capture_output=True,
                text=True,
                timeout=900,
            )
            assert done.returncode == 0, f"{block.code}\n{done.stdout}\n{done.stderr}"
            compare(done.stdout, block.output)
        else:
            printed = StringIO()
            with redirect_stdout(printed):
                exec(compile(block.code, page.name, "exec"), program)
            compare(printed.getvalue(), block.output)
    return program


def compare(printed: str, shown: str) -> None:
    """Hold what was printed against what the page shows: words exactly, numbers to 10 % or half of their last digit."""
    if not shown:
        return
    lines, wanted = printed.strip().splitlines(), shown.strip().splitlines()
    assert len(lines) == len(wanted), f"{printed}\nis not\n{shown}"
    for line, want in zip(lines, wanted, strict=True):
        assert NUMBER.sub("#", line).split() == NUMBER.sub("#", want).split(), f"{line!r} is not {want!r}"
        for a, b in zip(NUMBER.findall(line), NUMBER.findall(want), strict=True):
            digit = 10.0 ** -len(b.partition(".")[2])
            assert float(a) == pytest.approx(float(b), rel=0.1, abs=1.01 * digit), f"{line!r} is not {want!r}"
