"""`coopenv page`: environments in Markdown."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import complete, options

if TYPE_CHECKING:
    from coopenv.runs.console import Progress


def page(
    environments: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ENV...",
            help="Names of environments or TOML files.",
            show_default=False,
            autocompletion=complete.environments,
            callback=complete.known_environments,
        ),
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Every environment that ships with coopenv.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for ENV.md, ENV.png and ENV.webp.")] = Path("out", "pages"),
    measure: Annotated[
        bool,
        typer.Option("--measure", help="Measure what sensing is worth, for ENV.json; else what is there is shown."),
    ] = False,
    film: Annotated[
        bool,
        typer.Option("--film/--no-film", help="Film an episode for ENV.webp; else the film that is there is shown."),
    ] = True,
    worlds: Annotated[int, typer.Option(min=2, max=options.MOST_WORLDS, help="Held-out worlds to measure in.")] = 256,
) -> None:
    """Write the pages of environments: what they are, a picture, a film, what sensing is worth."""
    from coopenv.base.installation import list_envs
    from coopenv.bench import pages
    from coopenv.bench.agents.cards import entrants, has_dial
    from coopenv.runs.console import Progress

    if bool(environments) == everything:
        raise CoopenvError("name environments, or give --all for those that ship with coopenv")
    names = list_envs() if everything else list(environments or ())
    stems = {Path(text).stem: text for text in names}
    if len(stems) < len(names):
        raise CoopenvError("two environments have the same name")
    scenarios = {name: options.load(text, {}) for name, text in stems.items()}
    measured = [name for name in stems if measure and (has_dial(name) or not everything)]
    for name in measured:
        entrants(stems[name])
    pages.prepare(out, list(stems))
    log = options.console(stderr=True)
    with Progress(log, "pages", total=len(stems)) as progress:
        for number, (name, scenario) in enumerate(scenarios.items()):
            progress.update(number, name)
            if name in measured:

                def told(done: float, who: str, number: int = number, name: str = name) -> None:
                    progress.update(number + done, f"{name}, {who}")

                pages.write_figures(stems[name], name, scenario, out, worlds, told)
            pages.write_page(name, scenario, out, partial(_filming, progress, number, name) if film else None)
    if shipped := {name: options.load(name, {}) for name in list_envs() if (out / f"{name}.md").is_file()}:
        pages.write_index(shipped, out)
    options.console().print(f"Pages in {out}: {', '.join(f'{name}.md' for name in stems)}", soft_wrap=True)


def _filming(progress: "Progress", number: int, name: str, share: float) -> None:
    """Say how far the film of an environment is."""
    progress.update(number + share, f"{name}, film")
