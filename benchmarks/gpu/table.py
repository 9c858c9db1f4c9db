"""The section of docs/benchmarks.md that a run on a GPU fills, from its JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from coopenv.base.errors import CoopenvError
from coopenv.base.files import replace_text
from coopenv.base.format import number
from coopenv.report.table import markdown

BEGIN, END = "<!-- make gpu: begin -->", "<!-- make gpu: end -->"


def section(document: dict[str, Any]) -> str:
    """Return what stands between the marks: machine, throughput, agreement, training, tests, and what was left out."""
    rows = document["stages"]
    results = {row["name"]: row["result"] for row in rows if "result" in row}
    parts = [_machine(document, results.get("machine")), _throughput(results)]
    lines = [_agreement(name, result) for name, result in results.items() if name.startswith("agreement")]
    if "tests" in results:
        lines.append("CUDA tests: {passed} passed, {failed} failed.".format(**results["tests"]))
    if "training" in results:
        lines.append(_training(results["training"]))
    parts.append(" ".join(lines))
    left = [f"{row['name']}: {row.get('problem') or row['skipped']}" for row in rows if "result" not in row]
    parts += [f"{'; '.join(left)}."] if left else []
    return "\n\n".join(part for part in parts if part)


def _machine(document: dict[str, Any], found: dict[str, Any] | None) -> str:
    if found is None:
        return f"`{document['command']}`, coopenv {document['coopenv']}."
    device, place = found["device"], found["host"]
    versions = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
    return (
        f"`{document['command']}` on one {device['name']} ({device['memory_bytes'] / 2**30:.0f} GiB), "
        f"{place['cores_available']} cores of {place['processor']}; coopenv {document['coopenv']}, {versions}. Medians "
        "over rounds of a second."
    )


def _throughput(results: dict[str, dict[str, Any]]) -> str:
    """Return vehicle ticks/s: a row per observer and environment, a column per number of worlds."""
    found = {name: result for name, result in results.items() if name.startswith("throughput")}
    sizes = sorted({result["worlds"] for result in found.values()})
    rows: dict[str, list[str]] = {}
    for name, result in found.items():
        case, memory = name.split(", ")[1], f"{result['bytes_per_world'] / 1024:.0f}"
        row = rows.setdefault(case, [case, memory, *[""] * len(sizes)])
        row[2 + sizes.index(result["worlds"])] = _rate(result["vehicle_ticks_per_s"])
    columns = ("vehicle ticks/s", "KiB/world", *(f"{size:,} world{'s' * (size > 1)}" for size in sizes))
    return markdown(columns, list(rows.values())) if rows else ""


def _rate(value: float) -> str:
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if value >= size:
            return f"{number(value / size, 3)} {unit}"
    return number(value, 3)


def _agreement(name: str, found: dict[str, Any]) -> str:
    observer, largest = name.split(", ")[1], found["largest_difference"]
    difference = "not finite" if largest is None else f"{largest:.1e}"  # JSON has no infinity
    where = f" ({found['in']})" if found["worlds_alike"] < found["worlds"] else ""
    return (
        f"`{observer}` on CPU and device, float64: {found['worlds_alike']} of {found['worlds']} worlds alike, "
        f"largest difference {difference}{where}."
    )


def _training(found: dict[str, Any]) -> str:
    first, last = found["first"], found["last"]
    return (
        f"Training (`examples/train_ppo.py`, {found['env']}, {found['num_worlds']:,} worlds, one seed): "
        f"{found['vehicle_steps'] / 1e6:.1f} M vehicle steps at {_rate(found['steps_per_s'])} a second; return "
        f"{first['return']:.1f} to {last['return']:.1f}, {100 * last['arrived']:.0f} % arrive."
    )


def put(document: dict[str, Any], page: Path) -> None:
    """Put the section of a run into a page.

    Raises:
        CoopenvError: the document is none of `make gpu`, the page has no place for it, or the run was on a CPU.
    """
    if not isinstance(document, dict) or not {"command", "coopenv", "device", "stages"} <= document.keys():
        raise CoopenvError("--table: takes a JSON file that make gpu has written")
    if document["device"] == "cpu":
        raise CoopenvError("these figures are of a CPU; the page has room for those of a GPU")
    text = page.read_text(encoding="utf-8")
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise CoopenvError(f"{page}: needs one line '{BEGIN}' and after it one '{END}'")
    before, after = text.partition(BEGIN)[0], text.partition(END)[2]
    replace_text(page, f"{before}{BEGIN}\n\n{section(document)}\n\n{END}{after}")
