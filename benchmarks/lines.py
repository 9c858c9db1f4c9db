"""Where lines of Python went between two commits: a row per wing, and the files that changed most.

Usage: python -m benchmarks.lines 0.8.0            # up to the files that git would commit now
       python -m benchmarks.lines 0.8.0 HEAD
"""

from __future__ import annotations

import argparse
import subprocess
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
GUESTS = ("cars", "foxglove", "highway", "lanes", "mrclam", "sumo")
"""Wings of the package that do not count as its core."""
TOPS = ("benchmarks", "examples", "sitegen", "tests")
MOST = 15


def _git(*arguments: str) -> str:
    return subprocess.run(("git", "-C", str(ROOT), *arguments), check=True, capture_output=True, text=True).stdout


def lines_of(commit: str | None) -> Counter[str]:
    """Return the physical lines of every Python file of a commit, or of the present files."""
    if commit is None:
        paths = _git("ls-files", "--cached", "--others", "--exclude-standard", "*.py").splitlines()
        found = {path: ROOT / path for path in paths}
        return Counter({path: len(file.read_bytes().splitlines()) for path, file in found.items() if file.exists()})
    empty = _git("hash-object", "-t", "tree", "/dev/null").strip()
    rows = [
        row.split("\t") for row in _git("diff", "--numstat", "--no-renames", empty, commit, "--", "*.py").splitlines()
    ]
    return Counter({path: int(added) for added, _, path in rows})


def wing_of(path: str) -> str | None:
    """Return the wing of a file; None: it is not counted."""
    top, *inside = path.split("/")
    if top == "coopenv":
        return f"coopenv/{inside[0]}" if len(inside) > 1 else "coopenv"
    return top if top in TOPS else None


def wings_of(files: Counter[str]) -> Counter[str]:
    """Return the lines of every wing, of the core, and of the package with its guests."""
    found: Counter[str] = Counter()
    for path, lines in files.items():
        if wing := wing_of(path):
            found[wing] += lines
    package = [wing for wing in found if wing.startswith("coopenv")]
    guests = [f"coopenv/{guest}" for guest in GUESTS]
    found["total: core"] = sum(found[wing] for wing in package if wing not in guests)
    found["total: coopenv/"] = sum(found[wing] for wing in package)
    return found


def print_rows(before: Counter[str], after: Counter[str], names: Sequence[str]) -> None:
    """Print a row for each name."""
    for name in names:
        print(f"{name:52} {before[name]:7} {after[name]:7} {after[name] - before[name]:+7}")


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", help="a commit")
    parser.add_argument("after", nargs="?", help="a commit (default: the present files)")
    given = parser.parse_args()
    try:
        before, after = lines_of(given.before), lines_of(given.after)
    except subprocess.CalledProcessError as error:
        parser.error(error.stderr.strip().splitlines()[0])
    print(f"{'wing':52} {'before':>7} {'after':>7} {'change':>7}")
    old, new = wings_of(before), wings_of(after)
    print_rows(old, new, sorted({*old, *new}))
    print(f"\nfiles that changed most, of {len({*before, *after})}")
    changed = sorted({*before, *after}, key=lambda path: -abs(after[path] - before[path]))
    print_rows(before, after, [path for path in changed[:MOST] if before[path] != after[path]])


if __name__ == "__main__":
    main()
