"""`coopenv bench ...`: measure."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coopenv.base.errors import CoopenvError, listed
from coopenv.base.installation import is_reference
from coopenv.cli import arguments, commands, options

if TYPE_CHECKING:
    from coopenv.bench.observers.comparison import Plan

bench = commands.group("Compare observers, study seeds.")
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
    """Run many seeds at once: settling, and the steady errors."""
    scenario = options.load(environment, options.parse_overrides(overrides))
    from coopenv.bench.observers.convergence import seed_table, study_seeds
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


@dataclass(frozen=True, kw_only=True)
class ObserverOptions(options.DataOptions):
    """Options of `coopenv bench observers`."""

    source: options.Source
    observers: Annotated[
        str | None,
        typer.Option(
            help="Names of observers with commas between, or import paths, mine.py:Mine or package.module:Mine "
            "(default: all that suit).",
            **arguments.OBSERVERS,
        ),
    ] = None
    variants: Annotated[
        str | None,
        typer.Option(
            help="Names of variants with commas between, or `all`: faults of an environment, or of recorded robots."
        ),
    ] = None
    faults: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            metavar="[VEHICLE:]NAME[=VALUE][@START[+DURATION]][,OPTION=VALUE...]",
            help="Additional variant with a fault (see `coopenv list variants`), times in s: gyro_bias=0.01 or "
            "vehicle_2:lie=drift:0.05@10; commas between vehicles, / between faults. Repeatable.",
        ),
    ] = None
    policy: Annotated[
        str | None,
        typer.Option("--policy", "--agent", help="Agent or policy that drives in the records.", **arguments.POLICY),
    ] = None
    sensors: Annotated[
        bool,
        typer.Option(
            "--sensors",
            help="Compare with the camera alone, each other sensor alone, the camera with each, and all sensors.",
        ),
    ] = False
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Number of seeds (default: 5; recorded robots and logs have one record).")
    ] = None
    first: First = 0
    jobs: Annotated[
        int | None,
        typer.Option(min=1, help="Number of processes (default: one per core); 1 without limits: this process."),
    ] = None
    engine: Annotated[str, typer.Option(help="Where to compute: `local`, or `ray` (an existing cluster).")] = "local"
    address: Annotated[str | None, typer.Option(help="Address of the Ray cluster, HOST:PORT (default: auto).")] = None
    seconds: Annotated[
        float | None,
        typer.Option(min=0.1, help="Processor time after which an observer is ended on a record, s (default: 1800)."),
    ] = None
    memory: Annotated[
        float | None, typer.Option(min=1, help="Memory beyond which an observer is ended, MiB (default: 8192).")
    ] = None
    basin: Annotated[int, typer.Option(min=0, help="Random initial estimates for maps of the basins.")] = 0
    steady_from: options.SteadyFrom = None
    windows: Annotated[
        str | None,
        typer.Option(
            help="Edges of stretches of the run that are judged one by one, s, with commas between, or `none` "
            "(default: 5,10,20,35; of recorded robots none).",
            show_default=False,
        ),
    ] = None
    out: Annotated[Path | None, typer.Option(help="Folder for the leaderboard and the report.")] = None
    figures: Annotated[
        str | None, typer.Option("--figures", help="Also write figures as files to the folder: png, pdf or svg.")
    ] = None
    width: options.FigureWidth = None
    open_report: Annotated[bool, typer.Option("--open", help="Show the report when it is done; needs --out.")] = False
    as_json: options.AsJson = False

    @property
    def names(self) -> list[str] | None:
        """The observers that were given; None: all that suit."""
        return [word.strip() for word in self.observers.split(",")] if self.observers is not None else None

    def plan(self) -> "Plan":
        """Return the comparison, everything in it checked."""
        from coopenv.bench.observers.comparison import SEEDS, Plan
        from coopenv.bench.observers.sources import find_source, with_sensor_sets

        faults, chosen = self.faults or (), self.selection
        source = find_source(self.source, self.changes, self.data, self.topics, faults, self.policy, chosen)
        source = with_sensor_sets(source) if self.sensors else source
        seeds = range(self.first, self.first + (self.seeds or SEEDS)) if self.seeds or self.first else None
        return Plan.of(self.names, source, seeds, self.variants, self.steady_from, self.windows)

    def command_of(self, plan: "Plan") -> str:
        """Return the command line that gives the same tables again, with all names that a plan has chosen."""
        added, sets = {variant.name for variant in plan.source.added}, plan.source.sensor_sets
        named = [name for name in plan.variants if name not in added]
        faults = [name for name in plan.variants if name in added and name not in sets]
        observers = ",".join(dict.fromkeys(self.names or plan.observers))
        chosen = replace(self, observers=observers, variants=",".join(named) or None, faults=faults)
        return commands.command_text("bench observers", chosen, OF_THE_OUTPUT)


OF_THE_OUTPUT = ("jobs", "engine", "address", "seconds", "memory", "out", "figures", "width", "open_report", "as_json")
"""Options of `bench observers` that do not change the results."""


@bench.command("observers")
@commands.command
def bench_observers(given: ObserverOptions) -> None:
    """Compare observers on the same data and with their bound."""
    from coopenv.bench.executors import check_imports, find_executor
    from coopenv.bench.observers.command import REPORT_FILE, perform
    from coopenv.bench.observers.convergence import check_source

    if given.open_report and given.out is None:
        raise CoopenvError("--open: the report needs a folder, --out DIR")
    if given.width is not None and given.figures is None:
        raise CoopenvError(f"--width {given.width.value}: is for files of figures, --figures pdf")
    printed, log = options.console(), options.console(stderr=True)
    executor = find_executor(given.engine, given.jobs, given.address, given.seconds, given.memory)
    check_imports(executor, [name for name in given.names or () if is_reference(name)])
    plan = given.plan()
    if given.basin:
        check_source(plan.source)
    plan.source.check()
    board = perform(
        plan,
        given.command_of(plan),
        executor,
        printed,
        log,
        basin=given.basin,
        out=given.out,
        figures=given.figures,
        width=given.width and given.width.value,
        as_json=given.as_json,
    )
    if given.open_report and given.out is not None:
        options.show(given.out / REPORT_FILE)
    whole = {row.observer for row in board.rows if not row.failure}
    if lost := given.names and sorted({*board.ranked} - whole):
        raise CoopenvError(f"failed in every variant: {listed(lost)}")


@bench.command("v1")
def bench_v1(
    observers: Annotated[
        str,
        typer.Argument(
            metavar="OBSERVERS",
            help="mine.py:Mine, package.module:Mine or names, with commas between.",
            **arguments.OBSERVERS,
        ),
    ],
    scenes: Annotated[str | None, typer.Option(help="Some scenes only, with commas between, for a trial.")] = None,
    out: Annotated[Path, typer.Option(help="Result file.")] = Path("bench_v1.json"),
    jobs: Annotated[int | None, typer.Option(min=1, help="Number of processes (default: one per core).")] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="Another limit of processor time on a record, s; marks the result.")
    ] = None,
    memory: Annotated[float | None, typer.Option(min=1, help="Another limit of memory, MiB; marks the result.")] = None,
    as_json: options.AsJson = False,
) -> None:
    """Measure observers in the frozen benchmark, beside the rows of the zoo."""
    from coopenv.base.files import check_file, replace_text
    from coopenv.base.format import json_text
    from coopenv.base.installation import available_cores
    from coopenv.bench import frozen
    from coopenv.bench.executors import ProcessLimits
    from coopenv.runs.console import Progress

    check_file(out)
    benchmark, log = frozen.Frozen("v1"), options.console(stderr=True)
    usual = benchmark.limits
    limits = ProcessLimits(seconds or usual.seconds, memory or usual.mebibytes)
    with Progress(log, "bench v1", total=1.0) as progress:
        names, some = arguments.words(observers), arguments.words(scenes)
        result = benchmark.run(names, some, jobs or available_cores(), limits, progress.update)
    replace_text(out, json_text(result))
    if as_json:
        options.print_json(result)
    else:
        printed = options.console()
        for part in frozen.report(benchmark, result):
            printed.print(part, soft_wrap=isinstance(part, str), markup=False)
        printed.print(f"{out}: the result file", soft_wrap=True)
    if result["refused"]:
        raise CoopenvError("; ".join(result["refused"].values()))
    if lost := [total["observer"] for total in result["totals"] if total["failed"] == len(result["scenes"])]:
        raise CoopenvError(f"failed in every scene: {listed(lost)}")
