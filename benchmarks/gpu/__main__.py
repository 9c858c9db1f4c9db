"""`python -m benchmarks.gpu`: CUDA tests, CPU against CUDA, throughput and a training, within nine minutes."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.gpu.plan import SIZES, plan
from benchmarks.gpu.runner import failures, run
from benchmarks.gpu.table import put, section
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
            put(json.loads(asked.table.read_text(encoding="utf-8")), asked.page)
            print(f"{asked.page}: holds the figures of {asked.table}")
            return 0
        device = check_device(asked.device)
        with writing(asked.out):
            asked.out.parent.mkdir(parents=True, exist_ok=True)
        check_file(asked.out)
        head = {"command": shlex.join(["python", "-m", "benchmarks.gpu", *words]), "coopenv": version()}
        stages = plan(device, tuple(asked.worlds), asked.quick)
        document = run(stages, {**head, "device": device}, asked.out, 60.0 * asked.minutes, _tell)
    except (CoopenvError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"\n{section(document)}\n\n{asked.out}: all of it")
    if bad := failures(document):
        print(f"not as it has to be: {', '.join(bad)}", file=sys.stderr)
    return 1 if bad else 0


def _tell(line: str) -> None:
    print(line, flush=True)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    found = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    found.add_argument("--device", default="cuda:0", help="cuda:0, ...; cpu tries the run itself (default: cuda:0)")
    found.add_argument("--worlds", type=int, nargs="+", default=list(SIZES), help="whose throughput is measured")
    found.add_argument("--minutes", type=float, default=MINUTES, help=f"for everything (default: {MINUTES:g})")
    found.add_argument("--quick", action="store_true", help="as little as possible of everything")
    found.add_argument("--out", type=Path, default=Path("out", "gpu.json"), help="JSON file (default: out/gpu.json)")
    found.add_argument("--table", type=Path, metavar="FILE", help="run nothing; put the figures of FILE into the page")
    found.add_argument("--page", type=Path, default=PAGE, help="the page (default: docs/benchmarks.md)")
    return found


if __name__ == "__main__":
    sys.exit(main())
