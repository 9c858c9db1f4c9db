"""The command line: `coopenv list | describe | schema | run | record | bench`."""

from __future__ import annotations

import sys
import tomllib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from coopenv.errors import CoopenvError, DataWarning, OutputError

UsageError: Any = typer.BadParameter.__base__
"""What typer raises for every mistake in the options; it has no public name."""

INTERRUPTED = 130

app = typer.Typer(
    name="coopenv",
    help="Cooperative localisation of connected vehicles.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Environment = Annotated[str, typer.Argument(metavar="ENV", help="Name (see `coopenv list`) or path of a TOML file.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a dotted key of the scenario, e.g. noise.enabled=false; the value is TOML, or else a string. "
        "Repeatable.",
    ),
]
SteadyFrom = Annotated[
    float | None,
    typer.Option(help="Start of the steady state in s (default: 70 % of the horizon).", show_default=False),
]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status: 0, 2 after a mistake in the input, 130 after Ctrl-C."""
    try:
        status = app(args=arguments, standalone_mode=False)
    except (CoopenvError, UsageError) as error:
        message = error.format_message() if isinstance(error, UsageError) else str(error)
        print(f"error: {' '.join(message.split())}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, typer.Abort):
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    return status if isinstance(status, int) else 0


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    """Cooperative localisation of connected vehicles."""
    if version:
        from coopenv import __version__

        print(f"coopenv {__version__}")
    elif context.invoked_subcommand is None:
        print(context.get_help())


@app.command("list")
def list_command() -> None:
    """List the environments that ship with coopenv."""
    from coopenv.scenario import list_envs
    from coopenv.scenario.describe import environment_table

    out = console()
    out.print(environment_table({name: load(name, {}) for name in list_envs()}))


@app.command()
def describe(environment: Environment, overrides: Overrides = None) -> None:
    """Print a scenario for people: who is in it, how they sense and estimate, and what an observation holds."""
    from coopenv.scenario.describe import describe_scenario

    out = console()
    for part in describe_scenario(load(environment, parse_overrides(overrides))):
        out.print(part)


@app.command()
def schema(
    out: Annotated[Path | None, typer.Option(help="File to write (default: standard output).")] = None,
) -> None:
    """Write the JSON schema of scenario files, for editors and other tools."""
    from coopenv.runs.output import writing
    from coopenv.scenario.json_schema import schema_text

    if out is None:
        print(schema_text(), end="")
        return
    with writing(out):
        out.write_text(schema_text(), encoding="utf-8")


@app.command()
def run(
    environment: Environment,
    seed: Annotated[int, typer.Option(min=0, help="Of everything that is drawn.")] = 0,
    overrides: Overrides = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Decisions to run (default: up to the horizon).")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results (default: out/ENV).")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:0, ...")] = "cpu",
    dtype: Annotated[str, typer.Option(help="float32 or float64.")] = "float64",
    policy: Annotated[str, typer.Option(help="Of driven vehicles: zero, random, or the name of an agent.")] = "zero",
    steady_from: SteadyFrom = None,
    video: Annotated[bool, typer.Option("--video", help="Also film the top view.")] = False,
) -> None:
    """Run an environment and write metrics, record and figures."""
    parsed = parse_overrides(overrides)
    scenario = load(environment, parsed)
    from coopenv.runs.command import RunRequest, execute

    name = Path(environment).stem
    request = RunRequest(
        name=name,
        scenario=scenario,
        folder=out if out is not None else Path("out") / name,
        overrides=parsed,
        seed=seed,
        steps=steps,
        device=device,
        dtype=dtype,
        policy=policy,
        steady_from=steady_from,
        video=video,
    )
    if not execute(request, console(), console(stderr=True)):
        raise typer.Exit(INTERRUPTED)


@app.command("record")
def record_command(
    environment: Annotated[
        str, typer.Argument(metavar="ENV|DATASET", help="Environment, TOML file, or a data set such as mrclam_6.")
    ],
    out: Annotated[Path, typer.Option(help="MCAP file to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Of everything that is drawn.")] = 0,
    policy: Annotated[str, typer.Option(help="Of driven vehicles: zero, random, or the name of an agent.")] = "zero",
    overrides: Overrides = None,
    data: Annotated[Path | None, typer.Option(help="Folder of data sets (default: COOPENV_DATA).")] = None,
    variant: Annotated[str | None, typer.Option(help="Of a data set: landmarks, landmarks+robots, blind.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
) -> None:
    """Write what vehicles sense, tick by tick, to an MCAP file, which Foxglove opens and coopenv replays."""
    from coopenv.backends.mcap import check_target, write_recording
    from coopenv.backends.replay import is_recorded
    from coopenv.runs.log import read_recorded, simulate

    check_target(out)
    if out.exists() and not force:
        raise OutputError(f"{out}: exists already; --force replaces it")
    parsed = parse_overrides(overrides)
    if is_recorded(environment):
        asked = {"--set": parsed, "--seed": seed, "--policy": policy if policy != "zero" else None}
        with warned():
            recording = read_recorded(
                environment, data, variant, {name: value for name, value in asked.items() if value}
            )
    else:
        for option, value in (("--data", data), ("--variant", variant)):
            if value is not None:
                raise CoopenvError(f"{option} {value}: is for recorded data, {environment} is simulated")
        recording = simulate(load(environment, parsed), seed, policy)
    write_recording(recording, out)
    console().print(
        f"{out}: {len(recording.setups)} vehicles, {recording.ticks} ticks, {recording.t[-1]:g} s", soft_wrap=True
    )


bench = typer.Typer(help="Measure: steps per second, drivers.", no_args_is_help=True)
app.add_typer(bench, name="bench")


@bench.command("speed")
def bench_speed(
    environment: Annotated[str, typer.Argument(metavar="ENV", help="Environment to step.")] = "busy_intersection",
    overrides: Overrides = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.01, help="Time per case and round (default: 0.5).", show_default=False)
    ] = None,
    repeats: Annotated[
        int | None, typer.Option(min=1, help="Rounds, of which the median counts (default: 5).", show_default=False)
    ] = None,
    growth: Annotated[bool, typer.Option("--growth", help="Also grow vehicles, landmarks and worlds.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer cases and shorter rounds: under a minute.")] = False,
    peers: Annotated[bool, typer.Option(help="Also measure other projects' environments.")] = True,
    out: Annotated[Path | None, typer.Option(help="Folder for speed.json and pictures (default: none).")] = None,
) -> None:
    """Measure steps per second of coopenv and, where installed, of its peers, alternating in one run."""
    parsed = parse_overrides(overrides)
    scenario = load(environment, parsed)
    from coopenv.bench.speed import SpeedRequest, execute

    request = SpeedRequest(environment, scenario, parsed, seconds, repeats, out, growth, quick, peers)
    execute(request, console(), console(stderr=True))


@bench.command("agents")
def bench_agents(
    agents: Annotated[list[str] | None, typer.Argument(metavar="[AGENT]...", help="Default: all.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Episodes, seeds 0, 1, ...")] = 20,
) -> None:
    """Let drivers cross their environments: who arrives, who collides, who knows where it is."""
    from coopenv.api.parallel_env import parallel_env
    from coopenv.bench.agents import play, score
    from coopenv.bench.tables import score_table
    from coopenv.policies import list_agents, load_agent, read_card
    from coopenv.runs.command import progress

    rows = []
    for agent in agents or list_agents():
        for name in read_card(agent).environments:
            env = parallel_env(name)
            policy = load_agent(agent, env.observation_layout)
            with progress(console(stderr=True)) as bar:
                episodes = bar.track(range(seeds), description=f"{agent} in {name}")
                rows.append((agent, name, score(play(env, policy, seed) for seed in episodes)))
    console().print(score_table(rows))


@bench.command("seeds")
def bench_seeds(
    environment: Environment,
    seeds: Annotated[int, typer.Option(min=1, help="How many.")] = 20,
    first: Annotated[int, typer.Option(min=0, help="The first one.")] = 0,
    overrides: Overrides = None,
    steady_from: SteadyFrom = None,
) -> None:
    """Run an environment over many seeds at once: who settles, and the steady errors with their spread."""
    scenario = load(environment, parse_overrides(overrides))
    from coopenv.bench.seed_table import seed_table
    from coopenv.bench.seeds import study_seeds
    from coopenv.estimation.metrics import steady_start
    from coopenv.runs.command import progress

    start = steady_start(steady_from, scenario.horizon)
    with progress(console(stderr=True)) as bar:
        task = bar.add_task(f"{seeds} seeds", total=1.0)
        study = study_seeds(
            scenario, range(first, first + seeds), start, on_progress=lambda share: bar.update(task, completed=share)
        )
    out = console()
    out.print(seed_table(study))
    out.print(f"Steady: after {start:g} s. Settled: below 0.5 m and 5 deg until the end.")


@bench.command("observers")
def bench_observers(
    source: Annotated[
        str,
        typer.Argument(
            metavar="ENV|DATASET|FILE.mcap",
            help="Environment (name or TOML file), recorded robots (mrclam_1 .. mrclam_9) or a log file.",
        ),
    ],
    observers: Annotated[str | None, typer.Option(help="Names with commas between (default: all that suit).")] = None,
    variants: Annotated[
        str | None,
        typer.Option(help="Names with commas between, or `all`: faults of an environment, what recorded robots see."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Seeds 0, 1, ...")] = 5,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes (default: one per core).")] = None,
    engine: Annotated[str, typer.Option(help="`local`, or `ray`: an existing Ray cluster.")] = "local",
    address: Annotated[str | None, typer.Option(help="Of the Ray cluster: HOST:PORT (default: auto).")] = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder with the data of recorded robots (default: COOPENV_DATA).")
    ] = None,
    basin: Annotated[int, typer.Option(min=0, help="Random initial estimates for maps of the basins.")] = 0,
    overrides: Overrides = None,
    steady_from: SteadyFrom = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the leaderboard and the report.")] = None,
) -> None:
    """Compare observers on the same ticks, against the truth and the Cramér-Rao bound."""
    from coopenv.bench.leaderboard.command import perform, request_of
    from coopenv.bench.leaderboard.engines import find_engine

    printed, log = console(), console(stderr=True)
    with warned():
        request = request_of(
            source, observers, variants, seeds, steady_from, basin, data, parse_overrides(overrides), overrides or ()
        )
        request.source.check()
    perform(request, find_engine(engine, jobs, address), out, printed, log)


def console(stderr: bool = False) -> Console:
    """Return a console that prints scenario texts as they are."""
    return Console(stderr=stderr, markup=False, highlight=False, emoji=False)


def load(environment: str, overrides: dict[str, Any]) -> Any:
    """Return a scenario, its warnings printed as one line each."""
    from coopenv.scenario import load_scenario

    with warned():
        return load_scenario(environment, overrides)


@contextmanager
def warned() -> Iterator[None]:
    """Print the warnings of scenarios and data that are loaded meanwhile as one line each."""
    from coopenv.scenario import ScenarioWarning

    with warnings.catch_warnings(record=True) as caught:
        for category in (ScenarioWarning, DataWarning):
            warnings.simplefilter("always", category)
        yield
    for warning in (w for w in caught if issubclass(w.category, (ScenarioWarning, DataWarning))):
        print(f"warning: {warning.message}", file=sys.stderr)


def parse_overrides(assignments: Sequence[str] | None) -> dict[str, Any]:
    """Return `key=value` texts as a dict; a value that is not TOML is a string.

    Raises:
        CoopenvError: no `=`, or nothing before it.
    """
    overrides = {}
    for assignment in assignments or ():
        key, equals, text = assignment.partition("=")
        key, text = key.strip(), text.strip()
        if not equals or not key:
            raise CoopenvError(f"--set {assignment}: expected KEY=VALUE, e.g. --set noise.enabled=false")
        overrides[key] = parse_value(text)
    return overrides


def parse_value(text: str) -> Any:
    """Return a TOML value, or the text itself when it is none."""
    try:
        document = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text
    return document["value"] if len(document) == 1 else text


if __name__ == "__main__":
    sys.exit(main())
