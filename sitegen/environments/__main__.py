"""`python -m sitegen.environments ENV...`: pages of environments: description, picture, film, value of sensing.

`make pages` writes those of the environments that ship with coopenv to `docs/environments`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from coopenv.base.errors import CoopenvError
from coopenv.base.files import replace_text
from coopenv.base.installation import list_envs
from coopenv.cli.arguments import known_environment
from coopenv.cli.options import warned
from coopenv.report.terminal import Terminal
from coopenv.runs.console import Progress
from coopenv.sources.sources import open_simulation
from sitegen.environments import page, sensing


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(prog="python -m sitegen.environments", description=__doc__)
    parser.add_argument("environments", nargs="*", metavar="ENV", help="names of environments or TOML files")
    parser.add_argument("--all", action="store_true", help="every environment that ships with coopenv")
    parser.add_argument(
        "--out", type=Path, default=Path("out", "pages"), help="folder for ENV.md, ENV.png and ENV.webp"
    )
    parser.add_argument(
        "--measure", action="store_true", help="measure the value of sensing or cooperation; else ENV.json is shown"
    )
    parser.add_argument("--no-film", action="store_true", help="film no episode; a film that is there is shown")
    parser.add_argument("--worlds", type=int, default=256, help="held-out worlds to measure in (default: 256)")
    return parser.parse_args(arguments)


def write(asked: argparse.Namespace) -> None:
    """Write the pages, and the index of those that ship with coopenv."""
    if bool(asked.environments) == asked.all:
        raise CoopenvError("name environments, or give --all for those that ship with coopenv")
    if asked.worlds < 2:
        raise CoopenvError(f"--worlds {asked.worlds}: expected at least 2")
    names, out = list_envs() if asked.all else asked.environments, asked.out
    stems = {Path(text).stem: known_environment(text) or text for text in names}
    if len(stems) < len(names):
        raise CoopenvError("two environments have the same name")
    scenarios = {name: open_simulation(text, {}) for name, text in stems.items()}
    measured = [name for name in stems if asked.measure and (sensing.measured_drivers(name) or not asked.all)]
    for name in measured:
        sensing.contests(stems[name], scenarios[name], asked.worlds)
    page.prepare(out, list(stems))
    with Progress(Terminal(stderr=True), "pages", total=len(stems)) as progress:
        for number, (name, scenario) in enumerate(scenarios.items()):
            progress.update(number, name)

            def report(done: float, doing: str = "film", number: int = number, name: str = name) -> None:
                progress.update(number + done, f"{name}, {doing}")

            if name in measured:
                sensing.write_figures(stems[name], scenario, out, asked.worlds, report)
            page.write_page(name, scenario, out, None if asked.no_film else report)
    shipped = {name: open_simulation(name, {}) for name in list_envs() if (out / f"{name}.md").is_file()}
    if shipped:
        replace_text(out / page.INDEX, page.index_text(shipped))
    Terminal().print(f"Pages in {out}: {', '.join(f'{name}.md' for name in stems)}", soft_wrap=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the pages; return the exit status: 0, or 2 after a mistake in the input, in one line."""
    try:
        with warned():
            write(parsed(arguments))
    except CoopenvError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
