"""The leaderboard as files: JSON and CSV, both with every column."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from coopenv.bench.observers.rows import Row
from coopenv.estimation.metrics import json_ready
from coopenv.files import replacing_file
from coopenv.machine import versions

JSON_FILE, CSV_FILE, REPORT_FILE = "leaderboard.json", "leaderboard.csv", "report.html"
BASIN_FILE = "basin.csv"
FILES = (JSON_FILE, CSV_FILE, REPORT_FILE)


def document(rows: Sequence[Row], command: str, seeds: int, **more: Any) -> dict[str, Any]:
    """Return what `leaderboard.json` holds, as plain data; figures that do not exist are null."""
    table = [json_ready(asdict(row)) for row in rows]
    return {
        "command": command,
        "versions": versions("coopenv", "numpy", "scipy", "warp-lang"),
        "seeds": list(range(seeds)),
        "rows": table,
        **json_ready(more),
    }


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write plain data.

    Raises:
        OutputError: it cannot be written.
    """
    with replacing_file(path) as new:
        new.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


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
    with replacing_file(path) as new, new.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=columns)
        writer.writeheader()
        writer.writerows(table)
