"""`coopenv dataset` and `train`."""

from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coopenv.base.errors import CoopenvError
from coopenv.base.installation import install_command, needing
from coopenv.cli import arguments, commands, options

if TYPE_CHECKING:
    from coopenv.training.ranking import Ranking

Settings = Annotated[Path | None, typer.Option(help="TOML file of the settings (default: see docs/trainers.md).")]
Agent = Annotated[
    str | None,
    typer.Option(help="Agent with the settings, train.toml, in its folder.", **arguments.AGENT),
]
Onnx = Annotated[bool, typer.Option("--onnx", help="Also write the policy as an ONNX model.")]


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Options of `coopenv train`."""

    environment: options.Environment
    agent: Agent = None
    settings: Settings = None
    arm: Annotated[str | None, typer.Option(help="Table under `arms` of the settings that changes them.")] = None
    seed: Annotated[
        int | None, typer.Option(min=0, max=2**31 - 1, help="Seed of worlds, weights and exploration (default: 0).")
    ] = None
    steps: Annotated[
        int | None, typer.Option(min=1, help="Decisions of vehicles to learn from, in whole rollouts.")
    ] = None
    minutes: Annotated[float | None, typer.Option(min=1e-3, help="Longest time to learn, min; stops --steps.")] = None
    start: Annotated[
        str | None, typer.Option("--from", help="Learned agent that the training continues.", **arguments.AGENT)
    ] = None
    overrides: options.Overrides = None
    out: Annotated[Path | None, typer.Option(help="The agent's folder (default: out/train/ENV).")] = None
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the checkpoint in the folder, with its options.")
    ] = False
    threads: Annotated[int | None, typer.Option(min=1, help="Threads of the simulation (default: by cores).")] = None
    logs: Annotated[Path | None, typer.Option(help="Folder for TensorBoard (default: tensorboard/ in --out).")] = None
    onnx: Onnx = False
    force: Annotated[bool, typer.Option("--force", help="Replace the agent in the folder.")] = False
    as_json: options.AsJson = False

    def plan(self, folder: Path) -> Any:
        """Return what is learnt from what.

        Raises:
            CoopenvError: a setting is not valid, or an option stands beside --resume that the folder decides.
        """
        from coopenv.scenario.files import OVERRIDES
        from coopenv.training.command import resumed_plan
        from coopenv.training.settings import TrainingPlan

        if not self.resume:
            changes = options.parse_overrides(self.overrides)
            options.load(self.environment, changes)
            plan = TrainingPlan(self.environment, self._settings(changes), self.seed or 0, self.arm, changes)
            try:
                plan.scenarios()
            except CoopenvError as error:  # of the settings, because the options alone are possible
                raise CoopenvError(str(error).replace(OVERRIDES, str(self.settings or "settings"), 1)) from None
            return plan
        decided = {"--override": self.overrides, "--from": self.start}
        decided |= {
            f"--{name}": getattr(self, name) for name in ("agent", "settings", "arm", "seed", "steps", "minutes")
        }
        if named := [name for name, value in decided.items() if value is not None]:
            raise CoopenvError(f"--resume continues with the options of the checkpoint: leave out {', '.join(named)}")
        plan = resumed_plan(folder)
        if plan.environment != self.environment:
            raise CoopenvError(f"{folder} holds a training of {plan.environment}, not of {self.environment}")
        return plan

    def _settings(self, overrides: dict[str, Any]) -> Any:
        from coopenv.policies import find_agent
        from coopenv.training.settings import SETTINGS_FILE, continued_settings, read_settings, usual_settings

        path, changes = self.settings, {"steps": self.steps, "minutes": self.minutes, "start": self.start}
        name = Path(self.environment).stem
        if self.start is not None and (path, self.arm, self.agent) == (None, None, None):
            beside = (find_agent(self.start).folder or Path()) / SETTINGS_FILE
            if beside.is_file():
                return continued_settings(beside, name, **changes)
        if self.agent is not None:
            if path is not None:
                raise CoopenvError("--agent and --settings: give one of them")
            folder = find_agent(self.agent).folder
            if folder is None or not (folder / SETTINGS_FILE).is_file():
                raise CoopenvError(f"--agent {self.agent}: there is no {SETTINGS_FILE} beside it, so it was not learnt")
            path = folder / SETTINGS_FILE
        if path is None and self.arm is None:
            return usual_settings(self.environment, overrides, **changes)
        return read_settings(path, self.arm, name, **changes)


@commands.command
def train(given: TrainOptions) -> None:
    """Train one policy for all vehicles with PPO, and write it as an agent.

    The agent drives with `coopenv run ENV --policy DIR`. After an interruption go on with --resume.
    """
    options.load(given.environment, options.parse_overrides(given.overrides))  # mistakes before torch is loaded
    from dataclasses import asdict

    from coopenv.runs.console import Progress

    needs = f"torch, stable-baselines3, tensorboard and tomlkit: {install_command('train')}"
    with needing(f"coopenv train needs {needs}"):
        from coopenv.training.command import Reports
        from coopenv.training.command import train as perform
    folder = given.out or Path("out", "train", Path(given.environment).stem)
    plan, log = given.plan(folder), options.console(stderr=True)

    rankings: list[Ranking] = []

    def judged(name: str, results: list[Any]) -> None:
        log.print(f"{name:>16}, held-out maps: {_figures(results)}", soft_wrap=True)

    with Progress(log, "starting", total=1.0) as progress:
        reports = Reports(
            lambda status: progress.update(status.share, status.line),
            judged,
            lambda line: progress.update(0.0, line),
            rankings.append,
        )
        results = perform(
            plan,
            folder,
            resume=given.resume,
            threads=given.threads,
            onnx=given.onnx,
            logs=given.logs,
            force=given.force,
            reports=reports,
        )
    (ranking,) = rankings
    if given.as_json:
        rows = {"ranking": ranking.order, "missing": ranking.missing, "notes": ranking.notes}
        options.print_json({"agent": str(folder), "results": [asdict(result) for result in results], **rows})
        return
    options.console().print(
        f"Agent in {folder}: coopenv run {given.environment} --policy {quote(str(folder))}", soft_wrap=True
    )
    for line in (*ranking.notes, ranking.line):
        options.console().print(line, soft_wrap=True)


def _figures(results: list[Any]) -> str:
    """Return the main figures on one line, each with its interval."""
    figures = {result.metric: result for result in results}
    percent = {"arrival_rate": "arrived", "collision_rate": "hit"}
    parts = [f"{word} {_interval(figures[name], 100, 0)} %" for name, word in percent.items()]
    parts.append(f"e95 {_interval(figures['e95_m'], 100, 0)} cm")
    parts.append(f"return {_interval(figures['return'], 1, 1)}")
    return ", ".join(parts)


def _interval(figure: Any, factor: float, digits: int) -> str:
    mean, low, high = (f"{factor * value:.{digits}f}" for value in (figure.mean, figure.ci_low, figure.ci_high))
    return f"{mean} [{low}, {high}]"


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """Options of `coopenv dataset`."""

    environment: options.Source
    policy: Annotated[
        str,
        typer.Option(
            "--policy",
            help="Driver: random, the name of an agent, its folder, or mine.py:Mine.",
            **arguments.POLICY,
        ),
    ] = "route_follower"
    worlds: Annotated[
        int, typer.Option(min=1, max=options.MOST_WORLDS, help="Worlds; an episode of each of their vehicles is kept.")
    ] = 64
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the worlds.")] = 0
    overrides: options.Overrides = None
    identity: Annotated[
        str | None, typer.Option("--id", help="NAMESPACE/NAME-v0 of the dataset (default: coopenv/ENV/POLICY-v0).")
    ] = None
    out: Annotated[
        Path | None, typer.Option(help="Folder of datasets (default: MINARI_DATASETS_PATH or ~/.minari/datasets).")
    ] = None
    force: Annotated[bool, typer.Option("--force", help="Replace an existing dataset.")] = False


@commands.command
def dataset(given: DatasetOptions) -> None:
    """Write episodes of a policy as a Minari dataset, one per vehicle."""
    environment, policy, log = given.environment, given.policy, options.console(stderr=True)
    changes = options.parse_overrides(given.overrides)
    from coopenv.api.registration import registered_spec
    from coopenv.episode import RECORDED
    from coopenv.policies import load_policy
    from coopenv.runs.console import Progress, compile_notice
    from coopenv.runs.exports import STEPS, dataset_place, drive_vehicles, vehicle_episodes, write_dataset
    from coopenv.runs.recorder import record_episode
    from coopenv.sources.sources import open_backend

    backend = open_backend(environment, None, changes)
    scenario, recorded = backend.scenario, backend.capabilities.recorded
    if recorded:
        commands.refuse(given, ("policy", "worlds", "seed"), "recorded data have one world and no driver")
    driver = None if recorded else load_policy(policy, scenario, given.seed)
    spec = None if recorded else registered_spec(environment, changes)
    own = "recorded" if recorded else Path(policy.rpartition(":")[2] or policy).name
    identity = given.identity or f"coopenv/{Path(environment).stem}/{own}-v0"
    place = dataset_place(identity, given.out, given.force)
    with Progress(log, "replaying" if recorded else "driving", total=1.0) as progress, compile_notice(log):
        if driver is None:
            fields = (*RECORDED, *STEPS)
            episodes = vehicle_episodes(record_episode(backend, on_progress=progress.update, fields=fields))
        else:
            episodes = drive_vehicles(scenario, driver, given.seed, given.worlds, progress.update)
    again = commands.command_text("dataset", given, ("identity", "out", "force"))
    facts = {"algorithm_name": own, "description": f"{scenario.title}: {again}"}
    write_dataset(episodes, scenario, spec, place, identity, facts)
    steps = sum(len(episode.actions) for episode in episodes)
    size = f"{len(episodes)} episodes, {steps:,} steps"
    options.console().print(f"{place.parent}: {size}, minari.load_dataset('{identity}')", soft_wrap=True)
