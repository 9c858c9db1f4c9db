"""This checkout against another one: a process per side, asked in turn."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from coopenv.base.errors import CoopenvError
from coopenv.base.installation import ONE_THREAD

HERE = Path(__file__).resolve().parents[2]
SIDE = Path(__file__).with_name("side.py")
COMPILE = """
import time, numpy, warnings
warnings.simplefilter("ignore")
import coopenv
begin = time.process_time()
env = coopenv.make_vec({environment!r}, num_worlds=1, dtype={dtype!r}, overrides={overrides!r})
env.reset(seed=0)
env.step(numpy.zeros((env.num_envs, 2), dtype=numpy.float32))
print(time.process_time() - begin)
"""


@dataclass(frozen=True)
class Case:
    """Environment that both sides step."""

    environment: str
    worlds: int = 512
    dtype: str = "float32"
    overrides: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The case for people."""
        return f"{self.environment}, {self.overrides.get('observer.name', 'riccati')}"


class Side:
    """A process that steps the cases with the coopenv of one checkout."""

    def __init__(self, checkout: Path, cases: Sequence[Case], **more: str) -> None:
        """Start it, with more environment variables; `wait` before the first request.

        Raises:
            CoopenvError: there is no coopenv.
        """
        if not (checkout / "coopenv" / "__init__.py").is_file():
            raise CoopenvError(f"{checkout}: no checkout of coopenv")
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(SIDE), json.dumps([asdict(case) for case in cases])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=variables(checkout, **more),
            cwd=checkout,
            text=True,
        )

    def wait(self) -> None:
        """Wait until all is built.

        Raises:
            CoopenvError: it cannot be built.
        """
        self._line()

    def step(self, case: int, decisions: int) -> float:
        """Return the CPU time in s per vehicle tick."""
        assert self._process.stdin is not None
        print(json.dumps({"case": case, "decisions": decisions}), file=self._process.stdin, flush=True)
        return float(self._line())

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise CoopenvError(f"a side of the comparison ended with status {self._process.wait()}")
        return line

    def __enter__(self) -> Side:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()


def variables(checkout: Path, **more: str) -> dict[str, str]:
    """Return environment variables under which a checkout's coopenv is found, on one thread."""
    return {**os.environ, **ONE_THREAD, "PYTHONPATH": str(checkout), **more}


def compile_seconds(checkout: Path, case: Case) -> float:
    """Return the CPU time in s of building, resetting and stepping one world with an empty kernel cache.

    Raises:
        CoopenvError: it fails.
    """
    script = COMPILE.format(environment=case.environment, dtype=case.dtype, overrides=case.overrides)
    with tempfile.TemporaryDirectory() as cache:
        done = subprocess.run(
            [sys.executable, "-P", "-c", script],
            env=variables(checkout, WARP_CACHE_PATH=cache),
            cwd=checkout,
            capture_output=True,
            text=True,
        )
    if done.returncode != 0:
        raise CoopenvError(f"{checkout}: {(done.stderr.strip() or 'no output').splitlines()[-1]}")
    return float(done.stdout.split()[-1])
