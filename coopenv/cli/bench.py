"""`coopenv bench ...`: measure."""

from pathlib import Path
from typing import Annotated

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import options

bench = typer.Typer(help="Compare observers, study seeds.", no_args_is_help=True)
First = Annotated[int, typer.Option(min=0, help="The first seed.")]


@bench.command("seeds")
def bench_seeds(
    environment: options.Environment,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds.")] = 20,
    first: First = 0,
    overrides: options.Overrides = None,
    steady_from: options.SteadyFrom = None,
    as_json: options.AsJson = False,
) -> None:
    """Run many seeds at once: who settles, and the steady errors."""
    scenario = options.load(environment, options.parse_overrides(overrides))
    from coopenv.bench.seeds import seed_table, study_seeds
    from coopenv.estimation.metrics import SETTLED, steady_start
    from coopenv.runs.console import Progress

    start = steady_start(steady_from, scenario.horizon)
    with Progress(options.console(stderr=True), f"{seeds} seeds", total=1.0) as progress:
        study = study_seeds(scenario, range(first, first + seeds), start, on_progress=progress.update)
    if as_json:
        options.print_json(study.document(Path(environment).stem))
        return
    out = options.console()
    out.print(seed_table(study))
    out.print(f"Steady: after {start:g} s. Settled: below {SETTLED.text} until the end.")


@bench.command("observers")
def bench_observers(
    source: options.Source,
    observers: Annotated[
        str | None,
        typer.Option(
            help="Names of observers with commas between, or where classes stand, mine.py:Mine or package.module:Mine "
            "(default: all that suit).",
            **options.OBSERVERS,
        ),
    ] = None,
    variants: Annotated[
        str | None,
        typer.Option(
            help="Names of variants with commas between, or `all`: faults of an environment, what recorded robots see."
        ),
    ] = None,
    faults: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            metavar="NAME=VALUE[@VEHICLE][,OPTION=VALUE]",
            help="One more variant, with a fault that has parameters (see `coopenv list variants`): gyro_bias=0.01 "
            "or lie=drift:0.05@vehicle_2,from=10; several vehicles with : between, several faults with +. Repeatable.",
        ),
    ] = None,
    policy: Annotated[
        str | None,
        typer.Option("--policy", help="Agent or policy that drives in the records.", **options.POLICY),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds.")] = 5,
    first: First = 0,
    jobs: Annotated[int | None, typer.Option(min=1, help="Number of processes (default: one per core).")] = None,
    engine: Annotated[str, typer.Option(help="Where to compute: `local`, or `ray` (an existing cluster).")] = "local",
    address: Annotated[str | None, typer.Option(help="Address of the Ray cluster, HOST:PORT (default: auto).")] = None,
    data: options.DataFolder = None,
    topics: options.TopicMap = None,
    basin: Annotated[int, typer.Option(min=0, help="Random initial estimates for maps of the basins.")] = 0,
    overrides: options.Overrides = None,
    steady_from: options.SteadyFrom = None,
    windows: Annotated[
        str | None,
        typer.Option(
            help="Edges of stretches of the run that are judged one by one, s, with commas between, or `none` "
            "(default: 5,10,20,35; of recorded robots none).",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the leaderboard and the report.")] = None,
    figures: Annotated[
        str | None, typer.Option("--figures", help="Also write figures as files to the folder: png, pdf or svg.")
    ] = None,
    width: options.FigureWidth = None,
    open_report: Annotated[bool, typer.Option("--open", help="Show the report when it is done; needs --out.")] = False,
    as_json: options.AsJson = False,
) -> None:
    """Compare observers on the same data and with their bound."""
    from coopenv.bench.executors import find_executor
    from coopenv.bench.observers.command import REPORT_FILE, perform, request_of
    from coopenv.bench.observers.tables import WIDE

    if open_report and out is None:
        raise CoopenvError("--open: the report needs a folder, --out DIR")
    if width is not None and figures is None:
        raise CoopenvError(f"--width {width.value}: is for files of figures, --figures pdf")
    printed, log = options.console(), options.console(stderr=True)
    if not printed.is_terminal:
        printed.width = max(printed.width, WIDE)
    with options.warned():
        changes, numbers = options.parse_overrides(overrides), range(first, first + seeds)
        request = request_of(
            source,
            observers,
            variants,
            numbers,
            steady_from,
            basin,
            data,
            changes,
            overrides or (),
            topics,
            faults or (),
            policy,
            windows,
        )
        request.plan.source.check()
    perform(request, find_executor(engine, jobs, address), out, figures, printed, log, as_json, width and width.value)
    if open_report and out is not None:
        options.show(out / REPORT_FILE)


@bench.command("learning")
def bench_learning(
    study: Annotated[Path, typer.Argument(help="TOML file of the study, such as agents/study.toml.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the agents (default: beside the study).")] = None,
    only: Annotated[
        str | None,
        typer.Option(help="Part of it: environments, arms and seeds with commas between, such as facade,quality,1."),
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Trainings side by side (default: one per core).")] = None,
    worlds: Annotated[int, typer.Option(min=2, help="Number of held-out worlds for the cards.")] = 256,
    logs: Annotated[Path, typer.Option(help="Folder for TensorBoard's files.")] = Path("out", "tensorboard"),
) -> None:
    """Train agents by environment, arm and seed, and write their cards; goes on where it was interrupted."""
    try:
        from coopenv.bench import learning
    except ImportError as error:
        raise CoopenvError(f"coopenv bench learning needs the extra train: pip install '.[train]' ({error})") from None
    from coopenv.base.installation import available_cores
    from coopenv.bench.study import read_study

    words = [word.strip() for word in only.split(",") if word.strip()] if only else []
    whole, log = read_study(study), options.console(stderr=True)
    chosen, folder = whole.only(words), out or study.parent
    with options.warned():
        for group in chosen.groups:
            options.load(group.environment, chosen.settings[group].scenario)
    learning.run(whole, chosen, folder, logs, jobs or available_cores(), worlds, log)
    printed = options.console()
    if not printed.is_terminal:
        printed.width = max(printed.width, learning.WIDTH)
    printed.print(learning.results_table(chosen, folder))
    printed.print("Figures of the best seed, with 95 % intervals over worlds. More in every agent's card.md.")
