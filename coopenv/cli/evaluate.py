"""`coopenv evaluate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import arguments, commands, options


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Options of `coopenv evaluate`."""

    environment: options.Environment
    agents: Annotated[
        str | None,
        typer.Option(
            help="Agents with commas between: names, folders, or mine.py:Mine or package.module:Mine (default: every "
            "agent of agents/ that was made for ENV).",
            **arguments.AGENTS,
        ),
    ] = None
    worlds: Annotated[
        int, typer.Option(min=2, max=options.MOST_WORLDS, help="Number of held-out worlds, the same for every agent.")
    ] = 256
    seed_block: Annotated[int, typer.Option(min=0, help="Number of the block of held-out seeds.")] = 0
    overrides: options.Overrides = None
    ideal: Annotated[bool, typer.Option("--ideal", help="Also let route_follower drive under ideal sensing.")] = False
    stress: Annotated[
        bool, typer.Option("--stress", help="Also with other cameras, noise, landmarks and messages than in training.")
    ] = False
    out: Annotated[Path | None, typer.Option(help="Folder for evaluation.json and the figures.")] = None
    figures: Annotated[options.FigureFormat, typer.Option(help="Format of the figures.")] = options.FigureFormat.png
    width: options.FigureWidth = None
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Draw no figures and no replay.")] = False
    film: Annotated[
        bool, typer.Option("--film", help="Also write a film of the agents in one of the worlds, side by side.")
    ] = False
    write_card: Annotated[
        bool, typer.Option("--write-card", help="Write the results to card.json and card.md in the agents' folders.")
    ] = False
    force: Annotated[bool, typer.Option("--force", help="Replace an existing evaluation.")] = False
    as_json: options.AsJson = False


OF_THE_OUTPUT = ("out", "figures", "width", "no_figures", "film", "write_card", "force", "as_json")
"""Options of `evaluate` that do not change the results."""


@commands.command
def evaluate(given: EvaluateOptions) -> None:
    """Compare agents on held-out worlds: arrivals, collisions, time, errors."""
    from coopenv.bench import cards, evaluate
    from coopenv.bench.contest import Contest

    environment, agents, out, log = given.environment, given.agents, given.out, options.console(stderr=True)
    if given.film and out is None:
        raise CoopenvError("--film: the film needs a folder, --out DIR")
    if given.stress and (given.film or given.write_card):
        raise CoopenvError("--stress prints a table: leave out --film and --write-card")
    names = arguments.words(agents)
    if agents is not None and not names:
        raise CoopenvError(f"--agents {agents}: names no agent; leave it out for all agents of {environment}")
    changes = options.parse_overrides(given.overrides)
    contest = Contest.of(environment, changes, names, given.worlds, given.seed_block, given.ideal, given.stress)
    carded = cards.carded(contest) if given.write_card else []
    command = commands.command_text("evaluate", given, OF_THE_OUTPUT)
    drawn = {
        "figures": None if given.no_figures or given.stress else given.figures.value,
        "width": given.width and given.width.value,
    }
    result = evaluate.run(contest, command, log, out=out, film=given.film, force=given.force, **drawn)
    written = cards.write(result, carded, command)
    if given.as_json:
        options.print_json(evaluate.document(result, command))
        return
    printed = options.console()
    printed.print(result)
    if out is not None:
        printed.print(f"Files in {out}:", soft_wrap=True)
        printed.print(f"  {', '.join(sorted(path.name for path in out.iterdir()))}")
    for path in written:
        printed.print(f"Card: {path}", soft_wrap=True)
