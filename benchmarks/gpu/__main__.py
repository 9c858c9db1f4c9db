"""`python -m benchmarks.gpu`: CUDA tests, CPU against CUDA, throughput and a training, within nine minutes."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.gpu.plan import SIZES, Stage, plan
from benchmarks.gpu.runner import failures, run
from benchmarks.gpu.table import put, section
from benchmarks.options import at_least
from coopenv.base.errors import CoopenvError
from coopenv.base.files import check_file, writing
from coopenv.base.installation import version
from coopenv.world.model import check_device

MINUTES = 8.5
PAGE = Path(__file__).resolve().parents[2] / "docs" / "benchmarks.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all stages, or make the table of an earlier run; return the exit status.

    It is 0, 1 where a stage failed or worlds were not alike, and 2 after a mistake in the input.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    asked = parser().parse_args(words)
    try:
        if asked.table:
            try:
                put(json.loads(asked.table.read_text(encoding="utf-8")), asked.page)
            except (json.JSONDecodeError, UnicodeDecodeError, LookupError, TypeError, AttributeError):
                raise CoopenvError(f"--table: {asked.table}: expected a JSON file that make gpu has written") from None
            print(f"{asked.page}: holds the figures of {asked.table}")
            return 0
        device = check_device(asked.device)
        with writing(asked.out):
            asked.out.parent.mkdir(parents=True, exist_ok=True)
        check_file(asked.out)
        head = {"command": shlex.join(["python", "-m", "benchmarks.gpu", *words]), "coopenv": version()}
        stages = [s for s in plan(device, tuple(asked.worlds), asked.quick) if s.name.startswith(asked.only)]
        if not stages:
            raise CoopenvError(f"--only: no stage begins with '{asked.only}'")
        if asked.code.is_dir():
            os.environ["WARP_CACHE_PATH"] = str(asked.code.resolve())
        head["device"] = device
        earlier = _earlier(asked.out, head, stages) if asked.only else []
        document = run(stages, head, asked.out, 60.0 * asked.minutes, _tell, earlier)
    except (CoopenvError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"\n{section(document)}\n\n{asked.out}: all of it")
    if bad := failures(document):
        print(f"not as it has to be: {', '.join(bad)}", file=sys.stderr)
    return 1 if bad else 0


def _earlier(out: Path, head: dict[str, Any], stages: Sequence[Stage]) -> list[dict[str, Any]]:
    """Return the results that a file keeps of stages besides these, of the same device and version."""
    document = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {}
    if any(document.get(key) != head[key] for key in ("coopenv", "device")):
        return []
    return [row for row in document["stages"] if row["name"] not in {stage.name for stage in stages}]


def _tell(line: str) -> None:
    print(line, flush=True)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    found = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    found.add_argument("--device", default="cuda:0", help="cuda:0, ...; cpu tries the run itself (default: cuda:0)")
    found.add_argument(
        "--worlds", type=at_least(1), nargs="+", default=list(SIZES), help="whose throughput is measured"
    )
    found.add_argument("--minutes", type=at_least(0.1), default=MINUTES, help=f"for everything (default: {MINUTES:g})")
    found.add_argument("--only", default="", metavar="START", help="stages whose names begin so, such as throughput")
    found.add_argument("--code", type=Path, default=Path("out", "cuda"), help="of make cuda-check (default: out/cuda)")
    found.add_argument("--quick", action="store_true", help="as little as possible of everything")
    found.add_argument("--out", type=Path, default=Path("out", "gpu.json"), help="JSON file (default: out/gpu.json)")
    found.add_argument("--table", type=Path, metavar="FILE", help="run nothing; put the figures of FILE into the page")
    found.add_argument("--page", type=Path, default=PAGE, help="the page (default: docs/benchmarks.md)")
    return found


if __name__ == "__main__":
    sys.exit(main())
