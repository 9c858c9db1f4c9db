"""Commands of one interpreter that has imported what they share: each runs in a fork of its own, as a program does."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
SERVER = """
import json, os, sys

for line in sys.stdin:
    order = json.loads(line)
    child = os.fork()
    if child == 0:
        os.chdir(order["folder"])
        for descriptor, name in ((0, os.devnull), (1, order["stdout"]), (2, order["stderr"])):
            os.dup2(os.open(name, os.O_RDWR | os.O_CREAT, 0o600), descriptor)
        sys.argv = ["coopenv", *order["arguments"]]
        break
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
else:
    sys.exit()
sys.exit(main())
"""


class Done(NamedTuple):
    """What a command left."""

    returncode: int
    stdout: str
    stderr: str


class Commands:
    """Runs commands one after the other."""

    def __init__(self, process: subprocess.Popen[str], folder: Path) -> None:
        """Take over the interpreter, and a folder for what commands print."""
        self._process, self._folder, self._count = process, folder, 0

    def run(self, arguments: Sequence[str], folder: Path) -> Done:
        """Run `coopenv` with arguments in a folder."""
        self._count += 1
        printed = [self._folder / f"{self._count}.{name}" for name in ("stdout", "stderr")]
        order = {"arguments": [*arguments], "folder": str(folder)}
        order |= {path.suffix[1:]: str(path) for path in printed}
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        returncode = int(self._process.stdout.readline())
        return Done(returncode, *(path.read_text(encoding="utf-8") for path in printed))


@contextmanager
def commands(preamble: str, folder: Path) -> Iterator[Commands]:
    """Start an interpreter that runs the preamble, which imports what is shared and `main`, the command line's."""
    program = [sys.executable, "-c", preamble + SERVER]
    pipe = subprocess.PIPE
    variables = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(program, stdin=pipe, stdout=pipe, text=True, env=variables) as process:
        try:
            yield Commands(process, folder)
        finally:
            assert process.stdin is not None
            process.stdin.close()
            process.wait(timeout=60.0)
