"""`python -m benchmarks.speed`: measure coopenv and its peers, alternating in one run."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from benchmarks.options import at_least
from coopenv.base import interrupts


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write; return the exit status: 0, or 2 after a mistake in the input."""
    asked = parser().parse_args(arguments)
    from rich.console import Console

    from benchmarks.speed.report import FILES, show, write
    from benchmarks.speed.run import measured
    from coopenv.base.errors import CoopenvError
    from coopenv.base.files import replacing_folder
    from coopenv.cli.options import load, parse_overrides

    out = Console(markup=False, highlight=False, emoji=False)
    try:
        overrides = parse_overrides(asked.set)
        scenario = load(asked.environment, overrides)
        with nullcontext() if asked.out is None else replacing_folder(asked.out, FILES) as folder:
            report = measured(
                command(asked), asked.environment, scenario, overrides, seconds=asked.seconds or (0.15 if asked.quick
                else 0.5), rounds=asked.repeats or (3 if asked.quick else 5), peers=not asked.no_peers,
                growth=asked.growth, quick=asked.quick, log=Console(stderr=True),
            )  # fmt: skip
            show(report, out)
            files = [] if folder is None else write(report, folder)
        if files:
            out.print(f"Files in {asked.out}: {', '.join(path.name for path in files)}", soft_wrap=True)
    except CoopenvError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    found = argparse.ArgumentParser(prog="python -m benchmarks.speed", description=__doc__)
    found.add_argument("environment", nargs="?", default="busy_intersection", metavar="ENV")
    found.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a scenario key")
    found.add_argument("--seconds", type=at_least(1e-3), help="time per case and round (default: 0.5)")
    found.add_argument("--repeats", type=at_least(1), help="rounds, of which the median counts (default: 5)")
    found.add_argument("--growth", action="store_true", help="also grow vehicles, landmarks and worlds")
    found.add_argument("--quick", action="store_true", help="fewer cases and shorter rounds: under a minute")
    found.add_argument("--no-peers", action="store_true", help="leave other projects' environments out")
    found.add_argument("--out", type=Path, metavar="DIR", help="folder for speed.json and figures (default: none)")
    return found


def command(asked: argparse.Namespace) -> str:
    """Return the command line that asks for the same, but for `--out`."""
    words = ["python", "-m", "benchmarks.speed", asked.environment]
    words += [word for assignment in asked.set for word in ("--set", assignment)]
    words += [f"--{name}={value:g}" for name in ("seconds", "repeats") if (value := getattr(asked, name))]
    words += [f"--{name}" for name in ("growth", "quick", "no-peers") if getattr(asked, name.replace("-", "_"))]
    return shlex.join(words)


if __name__ == "__main__":
    interrupts.install()
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        interrupts.end(interrupts.report())
