"""`coopenv evaluate`: drivers on held-out worlds."""

from pathlib import Path
from typing import Annotated

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import complete, options


def evaluate(
    environment: options.Environment,
    agents: Annotated[
        str | None,
        typer.Option(
            help="Agents with commas between: names, folders, or mine.py:Mine or package.module:Mine (default: every "
            "agent of agents/ that was made for ENV).",
            **complete.AGENTS,
        ),
    ] = None,
    worlds: Annotated[
        int, typer.Option(min=2, max=options.MOST_WORLDS, help="Number of held-out worlds, the same for every agent.")
    ] = 256,
    seed_block: Annotated[int, typer.Option(min=0, help="Number of the block of held-out seeds.")] = 0,
    overrides: options.Overrides = None,
    ideal: Annotated[
        bool, typer.Option("--ideal", help="Also let route_follower drive where everybody sees everything.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for evaluation.json and the figures.")] = None,
    figures: Annotated[options.FigureFormat, typer.Option(help="Format of the figures.")] = options.FigureFormat.png,
    width: options.FigureWidth = None,
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Draw no figures and no replay.")] = False,
    film: Annotated[
        bool, typer.Option("--film", help="Also write a film of the agents in one of the worlds, side by side.")
    ] = False,
    write_card: Annotated[
        bool, typer.Option("--write-card", help="Write the results to card.json and card.md in the agents' folders.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an evaluation that is there.")] = False,
    as_json: options.AsJson = False,
) -> None:
    """Compare agents on held-out worlds: arrivals, collisions, time, errors."""
    from coopenv.bench.agents import cards, command

    if film and out is None:
        raise CoopenvError("--film: the film needs a folder, --out DIR")
    names = [word.strip() for word in agents.split(",") if word.strip()] if agents else []
    if agents is not None and not names:
        raise CoopenvError(f"--agents {agents}: names none; leave it out for all that were made for {environment}")
    changes, log = options.parse_overrides(overrides), options.console(stderr=True)
    request = command.Request(environment, names, worlds, seed_block, tuple(overrides or ()), changes, ideal)
    with options.warned():
        entrants = request.entrants()
    if write_card:
        cards.check(entrants)
    if out is None:
        result = command.run(request, entrants, log)
    else:
        form = None if no_figures else figures.value
        result = command.write(out, request, entrants, form, film, force, log, width and width.value)
    written = cards.write(result, request.command()) if write_card else []
    if as_json:
        options.print_json(command.document(request, result))
        return
    printed = options.console()
    if not printed.is_terminal:
        printed.width = max(printed.width, command.WIDTH)
    command.report(result, printed)
    if out is not None:
        printed.print(f"Files in {out}:", soft_wrap=True)
        printed.print(f"  {', '.join(sorted(path.name for path in out.iterdir()))}")
    for path in written:
        printed.print(f"Card: {path}", soft_wrap=True)
