"""The leaderboard as files: JSON and CSV, both with every column."""

from __future__ import annotations

import csv
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from coopenv.bench.leaderboard.rows import Row
from coopenv.estimation.metrics import json_ready
from coopenv.runs.output import writing

JSON_FILE, CSV_FILE, REPORT_FILE = "leaderboard.json", "leaderboard.csv", "report.html"
BASIN_FILE = "basin.csv"
FILES = (JSON_FILE, CSV_FILE, REPORT_FILE)

_PACKAGES = {"coopenv": "coopenv", "numpy": "numpy", "scipy": "scipy", "warp": "warp-lang"}


def versions() -> dict[str, str]:
    """Return the versions that the figures depend on."""
    found = {}
    for name, package in _PACKAGES.items():
        try:
            found[name] = version(package)
        except PackageNotFoundError:  # run from a checkout that is not installed
            found[name] = "unknown"
    return {**found, "python": platform.python_version()}


def document(rows: Sequence[Row], command: str, seeds: int, **more: Any) -> dict[str, Any]:
    """Return what `leaderboard.json` holds, as plain data; figures that do not exist are null."""
    table = [json_ready(asdict(row)) for row in rows]
    return {"command": command, "versions": versions(), "seeds": list(range(seeds)), "rows": table, **json_ready(more)}


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write plain data.

    Raises:
        OutputError: it cannot be written.
    """
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def write_rows(rows: Sequence[Row], path: Path) -> None:
    """Write the rows as CSV; figures that do not exist are empty.

    Raises:
        OutputError: it cannot be written.
    """
    write_csv([json_ready(asdict(row)) for row in rows], [f.name for f in fields(Row)], path)


def write_csv(table: Sequence[Mapping[str, Any]], columns: Sequence[str], path: Path) -> None:
    """Write a table.

    Raises:
        OutputError: it cannot be written.
    """
    with writing(path), path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=columns)
        writer.writeheader()
        writer.writerows(table)
