"""Run stages one after the other, each for so long at most, and keep every result as soon as it is there."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.gpu.plan import Stage
from benchmarks.gpu.work import MARK, ROOT
from coopenv.base.files import replace_text
from coopenv.base.format import json_text

LEAST = 5.0
"""s that have to be left for a stage to begin."""
LOG_LINES = 60
"""The last lines of a stage that failed which are kept: a second try on a rented machine is dear."""


def run(
    stages: Sequence[Stage],
    head: dict[str, Any],
    out: Path,
    seconds: float,
    tell: Callable[[str], None] = lambda line: None,
    earlier: Sequence[dict[str, Any]] = (),
) -> dict[str, Any]:
    """Run stages and write the document anew after each.

    Args:
        stages: in their order.
        head: what the document says before them.
        out: JSON file.
        seconds: for all of them together; what does not begin in time is left out, with a line.
        tell: called with a line per stage that has ended.
        earlier: results of other stages, which the document keeps.
    """
    document: dict[str, Any] = {**head, "stages": [*earlier]}
    end = time.monotonic() + seconds
    for stage in stages:
        left = end - time.monotonic()
        begin = time.monotonic()
        outcome = run_stage(stage, min(stage.limit, left)) if left >= LEAST else {"skipped": "no time was left"}
        row = {"name": stage.name, "limit_s": stage.limit, "wall_s": time.monotonic() - begin, **outcome}
        document["stages"].append(row)
        replace_text(out, json_text(document))
        tell(f"{stage.name}: {summary(row)}")
    return document


def run_stage(stage: Stage, limit: float) -> dict[str, Any]:
    """Return `result` of a stage that runs in a process of its own, or `skipped` or `problem`, on one line."""
    command = [sys.executable, "-m", "benchmarks.gpu.work", stage.work, json.dumps(stage.arguments)]
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        env=variables,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        said, complained = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        return {"problem": f"ended after its limit of {limit:.0f} s"}
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    results = [line.removeprefix(MARK) for line in said.splitlines() if line.startswith(MARK)]
    if process.returncode != 0 or not results:
        lines = (complained.strip() or said.strip() or "no output").splitlines()
        log = "\n".join(f"{said}\n{complained}".splitlines()[-LOG_LINES:])
        return {"problem": f"{lines[-1][:300]} (exit status {process.returncode})", "log": log}
    result = json.loads(results[-1], parse_constant=lambda word: None)
    return result if "skipped" in result else {"result": result}


def summary(row: dict[str, Any]) -> str:
    """Return what became of a stage, on one line."""
    if "result" not in row:
        return f"{row.get('problem') or row['skipped']}"
    result = row["result"]
    shown = [f"{key} {value:.4g}" for key, value in result.items() if isinstance(value, int | float)]
    return ", ".join(shown) or "done"


def failures(document: dict[str, Any]) -> list[str]:
    """Return the names of the stages that went wrong, or whose results are not as they have to be."""
    return [row["name"] for row in document["stages"] if "problem" in row or _is_bad(row.get("result", {}))]


def _is_bad(result: dict[str, Any]) -> bool:
    """Return whether tests failed, or none ran, or worlds are not alike."""
    tests = "passed" in result and (result["failed"] > 0 or result["passed"] == 0)
    return bool(tests or result.get("worlds_alike", 0) < result.get("worlds", 0) * ("worlds_alike" in result))
