"""`coopenv train`: learn, judge on held-out maps, keep checkpoints, and write the agent's folder. Needs `train`.

A checkpoint holds all that the next update depends on, in one file without pickle: a safetensors file of arrays, whose
header holds the plan, how far the training is, and its curve. It is replaced as a whole, so that a run that is killed
while writing keeps the one before.
"""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from stable_baselines3.common.logger import configure

from coopenv.api.engine import Engine
from coopenv.base import interrupts
from coopenv.base.errors import CoopenvError, OutputError
from coopenv.base.files import check_file, new_folder, replacing_file, replacing_folder, writing
from coopenv.base.seeds import evaluation_seed
from coopenv.evaluation import Result, drive, held_out_seeds, ranking_key, score
from coopenv.policies import Policy, load_agent
from coopenv.policies.alone import Alone
from coopenv.policies.loader import AGENT_FILE, CARD_FILES, CHECKPOINT_FILE, check_agent
from coopenv.policies.network import RightOfWay
from coopenv.scenario import Scenario
from coopenv.sources.sources import open_simulation
from coopenv.training.actions import actions_of
from coopenv.training.batches import Arrays
from coopenv.training.export import EXPORTED, check_onnx, export
from coopenv.training.ranking import Figures, Ranking, figures_of
from coopenv.training.sets import SetTrainer
from coopenv.training.settings import Settings, TrainingPlan, check_settings, environment_file
from coopenv.training.trainer import DivergedError, Status, Trainer, tensors_of

NAMES = (*EXPORTED, CHECKPOINT_FILE, *CARD_FILES)
"""Names of files in an agent's folder; a card belongs to a single agent, and is removed with it."""
LOGS = "tensorboard"
WHILE_LEARNING = 2**30
"""Number of the first seed for evaluation that is looked at while learning; `coopenv evaluate` begins with number 0."""
KEPT_FOR = 60.0  # s of learning after which at the latest there is a checkpoint
FORMAT = 4
HEADER = "coopenv_checkpoint"
Judge = Callable[[Policy, str, list[int]], list[Result]]
"""Returns the figures of a driver, with its name, in the worlds of some seeds."""


@dataclass(frozen=True)
class Reports:
    """Callbacks of a training."""

    status: Callable[[Status], None] = lambda status: None
    """After every update."""
    judged: Callable[[str, list[Result]], None] = lambda name, results: None
    """After every look at held-out maps: name of the driver, or decisions of vehicles so far, and figures."""
    cloning: Callable[[str], None] = lambda line: None
    """Before the first update: a line on what is done, such as the cloning of another driver."""
    ranked: Callable[[Ranking], None] = lambda ranking: None
    """At the end."""


class Course(BaseModel):
    """Findings of a training so far, beside the state of its trainer."""

    model_config = ConfigDict(ser_json_inf_nan="constants")
    curve: list[dict[str, int | float]] = Field(default_factory=list)
    """Figures in worlds for validation, a row per look."""
    drivers: dict[str, Figures] = Field(default_factory=dict)
    """Figures of other drivers, and of the clone, in the held-out worlds of the end."""
    teacher: str = ""
    """The agent that is cloned, if any."""
    best: dict[str, Any] = Field(default_factory=dict, exclude=True)
    """Tensors of the policy of the best row of the curve."""

    @property
    def best_row(self) -> dict[str, int | float]:
        """The best row of the curve; the first of equal ones."""
        return min(self.curve, key=ranking_key)


def resumed_plan(out: Path) -> TrainingPlan:
    """Return the plan of the unfinished training in a folder.

    Raises:
        CoopenvError: there is none, or its checkpoint is damaged.
    """
    if not (out / CHECKPOINT_FILE).is_file() and (out / AGENT_FILE).is_file():
        raise CoopenvError(f"nothing to resume: {out} holds a finished agent and no checkpoint")
    return read(out / CHECKPOINT_FILE).plan


def possible(plan: TrainingPlan) -> Scenario:
    """Return the scenario of a training, before anything is made.

    Raises:
        CoopenvError: no vehicle is driven there, a variation is not possible, a driver of the ranking is unknown, or
            the driver to begin as, the right of way, or the driver `alone`, lacks what it needs to see.
    """
    scenario = open_simulation(plan.environment, plan.all_overrides)
    if not any(scenario.acting):
        raise CoopenvError(f"{plan.environment}: all motion is prescribed or has a driver, there is nothing to learn")
    if plan.settings.start is not None:
        tensors_of(plan.settings.start, scenario, plan.settings.ppo.observation_clip, plan.settings.actions)
    for name in plan.settings.evaluation.drivers:
        check_agent(name, "driver (evaluation.drivers)")
    try:
        rule = "right_of_way"
        if plan.settings.right_of_way:
            RightOfWay(scenario)
        rule = "alone"
        if plan.settings.alone is not None:
            Alone(scenario, plan.settings.alone)
    except (CoopenvError, ValueError) as error:
        raise CoopenvError(f"{rule}: {error}") from None
    for own in plan.watched():
        try:
            for each, _ in own.scenarios():
                actions = actions_of(plan.settings.actions, each)
                for name in plan.settings.clone.agents if plan.settings.clone else ():
                    actions.teacher(name, each)
        except CoopenvError as error:
            if own is plan:
                raise
            raise CoopenvError(f"clone.elsewhere: {own.environment}: {error}") from None
    return scenario


def train(
    plan: TrainingPlan,
    out: Path,
    *,
    resume: bool = False,
    threads: int | None = None,
    onnx: bool = False,
    logs: Path | None = None,
    force: bool = False,
    reports: Reports | None = None,
) -> list[Result]:
    """Train a policy and write it as an agent to a folder.

    While it learns the folder holds `checkpoint.safetensors`, and `tensorboard/` unless `logs` says otherwise. When it
    is finished the agent takes the checkpoint's place, at once and as a whole.

    Args:
        plan: the plan of the training.
        out: the agent's folder.
        resume: go on from the folder's checkpoint, which is of the same plan, and with the outputs that it began with.
        threads: shares of the batch on the CPU; results do not depend on it.
        onnx: also write an ONNX model.
        logs: folder for TensorBoard.
        force: let the finished agent replace an existing one.
        reports: callbacks.

    Returns:
        The results on held-out maps, as in `agent.toml`.

    Raises:
        CoopenvError: the plan does not describe a possible training, there is nothing to resume, there is an unfinished
            training that is not to be resumed, or the package onnx is missing.
        OutputError: there is an agent that is not to be replaced, or a `train.toml` of the user's with other settings,
            or something cannot be written; the last checkpoint stays.
    """
    report, path = reports or Reports(), out / CHECKPOINT_FILE
    scenario, environment = possible(plan), environment_file(plan.environment, plan.all_overrides)
    kept = read(path) if resume else None
    if kept is not None:
        onnx, logs = onnx or kept.onnx, logs or kept.logs
    elif path.is_file():
        raise CoopenvError(f"{out} holds an unfinished training: go on with --resume, or remove {path}")
    elif (out / AGENT_FILE).exists() and not force:
        raise OutputError(f"{out / AGENT_FILE}: exists already; --force replaces the agent")
    check_settings(out, plan, environment)
    if onnx:
        check_onnx(plan.settings)
    course = kept.course if kept is not None else Course()
    seeds = held_out_seeds(0, plan.settings.evaluation.final_worlds)
    judge = partial(_judge, scenario, threads, report)
    if kept is None and plan.settings.clone:
        course.teacher = _best_teacher(scenario, plan.settings, plan.settings.clone.agents, judge)
    if plan.settings.network and plan.settings.clone:
        _judge_drivers(plan, scenario, course, report, judge)
        clone = plan.settings.clone.model_copy(update={"agent": course.teacher})
        cloned = SetTrainer(plan, scenario, clone, threads)
        cloned.begin(report.cloning)
        results = judge(cloned.mean_action, out.name, seeds)
        with replacing_folder(out, (*NAMES, environment.name, *environment.code)) as folder:
            export(folder, out, cloned, environment, results, [])
        report.ranked(_ranking(out, course, results, ()))
        return results
    with closing(Trainer(plan, scenario, threads)) as trainer:
        trainer.teacher = course.teacher
        with new_folder(out), new_folder(logs or out / LOGS) as tensorboard:
            check_file(path)
            trainer.model.set_logger(configure(str(tensorboard), ["tensorboard"]))
        if kept is not None:
            restore(kept, trainer)
        else:
            _judge_drivers(plan, scenario, course, report, judge)
            trainer.begin(report.cloning)
            if plan.settings.steps and (plan.settings.clone or plan.settings.start):
                first = "clone" if plan.settings.clone else "start"
                course.drivers[first] = figures_of(judge(trainer.driver(), first, seeds))
        try:
            _learn(trainer, course, report, judge, partial(save, path, trainer, course, onnx, logs))
            if course.best:
                trainer.take(course.best)
            results = judge(_finished(trainer), out.name, seeds)
        except DivergedError as error:
            if not path.is_file():
                raise
            left = f"{path} is kept as it was after {read(path).progress['steps']} steps"
            raise DivergedError(f"{error}; {left}, remove it to begin anew with other settings") from None
        with replacing_folder(out, (*NAMES, environment.name, *environment.code)) as folder:
            export(folder, out, trainer, environment, results, course.curve, onnx)
        report.ranked(_ranking(out, course, results, _notes(trainer, course)))
    return results


def _finished(trainer: Trainer) -> Policy:
    """Return the driver that the agent is: the policy, and in its place the driver of those who are alone."""
    alone = trainer.plan.settings.alone
    return trainer.driver(*([Alone(trainer.scenario, alone)] if alone is not None else []))


def _ranking(out: Path, course: Course, results: list[Result], notes: Iterable[str]) -> Ranking:
    """Return the rank of a policy by its folder's name, among the drivers that were judged before."""
    name = f"new {out.name}" if out.name in course.drivers else out.name
    return Ranking(name, {**course.drivers, name: figures_of(results)}, tuple(notes))


def _notes(trainer: Trainer, course: Course) -> Iterator[str]:
    """Yield what is to be known of a training that did not go on to its end, or whose last policy is not the best."""
    status, settings = trainer.status, trainer.plan.settings
    yield from trainer.notes
    if settings.clone and len(settings.clone.agents) > 1:
        yield f"Cloned: {course.teacher}, the best of {len(settings.clone.agents)} agents in the worlds for validation"
    if status.share < 1.0:
        spent = f"{status.steps:,} of {settings.steps:,} steps"
        yield f"Stopped by --minutes {settings.minutes:g} after {spent}: another load gives another agent"
    if course.curve and settings.evaluation.keep == "best" and (steps := course.best_row["steps"]) < status.steps:
        yield f"Kept: the policy after {steps:,} steps, the best in the worlds for validation"


def _best_teacher(scenario: Scenario, settings: Settings, names: Sequence[str], judge: Judge) -> str:
    """Return the best of several agents in the worlds for validation."""
    if len(names) == 1:
        return names[0]
    figures = {name: figures_of(judge(load_agent(name, scenario), name, _validation(settings))) for name in names}
    return min(names, key=lambda name: ranking_key(figures[name]))


def _validation(settings: Settings) -> list[int]:
    """Return the seeds of the worlds that are looked at while learning."""
    return [evaluation_seed(WHILE_LEARNING + world) for world in range(settings.evaluation.worlds)]


def _judge_drivers(plan: TrainingPlan, scenario: Scenario, course: Course, report: Reports, judge: Judge) -> None:
    """Judge the drivers that the policy is ranked among, as far as they can drive."""
    seeds = held_out_seeds(0, plan.settings.evaluation.final_worlds)
    cloned, able = plan.settings.clone.agents if plan.settings.clone else (), list[tuple[str, Policy]]()
    for name in dict.fromkeys((*cloned, *plan.settings.evaluation.drivers)):
        with suppress(CoopenvError):
            policy = load_agent(name, scenario)
            able.append((name, policy))
    for name, policy in able:
        report.cloning(f"judging {name}")
        course.drivers[name] = figures_of(judge(policy, name, seeds))


def _learn(trainer: Trainer, course: Course, report: Reports, judge: Judge, keep: Callable[[], None]) -> None:
    """Update until all steps are done or time is up; judge every so often, and keep the best policy.

    A checkpoint follows every look at worlds for validation, or a minute's updates.
    """
    settings, kept = trainer.plan.settings, trainer.seconds
    evaluation, longest = settings.evaluation, 60.0 * (settings.minutes or np.inf)
    seeds = _validation(settings)

    def look() -> None:
        status = trainer.status
        means = figures_of(judge(trainer.driver(), f"{status.steps:,} steps", seeds))
        trainer.record(means)
        course.curve.append({"steps": status.steps, "seconds": round(status.seconds, 1), **means})
        if evaluation.keep == "last" or course.best_row is course.curve[-1]:
            course.best = trainer.tensors()

    if trainer.status.steps == 0:
        if settings.steps and (settings.clone or settings.start):
            look()
        keep()
    while (status := trainer.status).share < 1.0 and trainer.seconds < longest:
        before = status.steps // evaluation.every
        status = trainer.update()
        report.status(status)
        ends = status.share == 1.0 or trainer.seconds >= longest
        if due := ends or status.steps // evaluation.every > before:
            look()
        if (due or status.seconds - kept > KEPT_FOR) and not ends:
            kept = status.seconds
            keep()


def _judge(
    scenario: Scenario, threads: int | None, report: Reports, policy: Policy, name: str, seeds: list[int]
) -> list[Result]:
    """Return the figures of a driver in the worlds of some seeds."""
    with closing(Engine(scenario, len(seeds), threads=threads)) as engine:
        results = score(drive(engine, policy, seeds))
    report.judged(name, results)
    return results


class Checkpoint(BaseModel):
    """Contents of a checkpoint file."""

    model_config = ConfigDict(ser_json_inf_nan="constants")
    format: int = FORMAT
    plan: TrainingPlan
    scenario: str
    """JSON of the scenario, to find out whether it is still the same."""
    progress: dict[str, int | float]
    """`steps`, `seconds`, `cpu_seconds`, and whether the critic still learns alone."""
    course: Course
    onnx: bool = False
    """Write an ONNX model, too, as on the command line."""
    logs: Path | None = None
    """Folder for TensorBoard; None: in the agent's folder."""
    path: Path = Field(default=Path(), exclude=True)
    arrays: dict[str, dict[str, Any]] = Field(default={}, exclude=True, repr=False)
    """Arrays by the object that they restore, and by name."""


def save(path: Path, trainer: Trainer, course: Course, onnx: bool = False, logs: Path | None = None) -> None:
    """Write a checkpoint in the place of the one before.

    Raises:
        OutputError: it cannot be written; the one before is whole.
    """
    state = {"critic_alone": trainer.model.critic_alone, "cpu_seconds": trainer.cpu_seconds}
    header = Checkpoint(
        plan=trainer.plan,
        scenario=trainer.scenario.model_dump_json(),
        progress={"steps": trainer.model.num_timesteps, "seconds": trainer.seconds, **state},
        course=course,
        onnx=onnx,
        logs=logs and logs.absolute(),
    )
    with replacing_file(path) as new, writing(path):
        try:
            best = {f"best/{name}": values for name, values in course.best.items()}
            save_file({**_arrays(trainer), **best}, new, metadata={HEADER: header.model_dump_json()})
        except SafetensorError as error:  # what the system says of a full disk comes as one of these
            raise OSError(str(error)) from None
    interrupts.note(f"kept: {path} after {trainer.status.steps} steps; go on with --resume")


def read(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        CoopenvError: there is none, it is damaged, or of another version.
    """
    if not path.is_file():
        raise CoopenvError(f"nothing to resume: there is no {path}")
    try:
        arrays: dict[str, Arrays] = defaultdict(dict)
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {})[HEADER])
            for key in file.keys():  # noqa: SIM118 (not a dict)
                group, _, name = key.partition("/")
                arrays[group][name] = file.get_tensor(key)
        if header["format"] != FORMAT:
            raise CoopenvError(f"{path}: a checkpoint of format {header['format']}, expected {FORMAT}")
        checkpoint = Checkpoint.model_validate({**header, "path": path, "arrays": arrays})
        checkpoint.course.best = arrays["best"]
        return checkpoint
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, CoopenvError):
            raise
        raise CoopenvError(f"{path}: damaged, or not a checkpoint ({error}); remove it to start anew") from None


def restore(checkpoint: Checkpoint, trainer: Trainer) -> None:
    """Let a trainer of the same plan go on from a checkpoint.

    Raises:
        CoopenvError: it does not fit: the environment has changed since, or the file has been edited.
    """
    if checkpoint.scenario != trainer.scenario.model_dump_json():
        name = trainer.plan.environment
        raise CoopenvError(f"{checkpoint.path}: {name} has changed since; remove the file to start anew")
    policy, arrays = trainer.model.policy, checkpoint.arrays
    try:
        if checkpoint.course.best:
            trainer.take(checkpoint.course.best)  # it fits, as it has to at the end
        trainer.take(arrays["policy"])
        moments: dict[int, dict[str, torch.Tensor]] = defaultdict(dict)
        for name, values in _tensors(arrays.get("optimiser", {})).items():
            index, _, moment = name.partition("/")
            moments[int(index)][moment] = values
        policy.optimizer.load_state_dict({**policy.optimizer.state_dict(), "state": moments})
        trainer.env.returns[...] = arrays["statistics"]["returns"]
        torch.set_rng_state(torch.from_numpy(arrays["random"]["torch"]))
        key, position = np.split(arrays["random"]["numpy"], [-1])
        np.random.set_state({"bit_generator": "MT19937", "state": {"key": key, "pos": int(position[0])}})
        trainer.model.num_timesteps = int(checkpoint.progress["steps"])
        trainer.seconds, trainer.cpu_seconds = checkpoint.progress["seconds"], checkpoint.progress["cpu_seconds"]
        trainer.model.critic_alone = bool(checkpoint.progress["critic_alone"])
        if "world" in arrays:
            if trainer.remembering and "memory" in arrays["statistics"]:
                trainer.remembering.go_on_from(arrays["statistics"]["memory"])
            trainer.env.go_on_from(trainer.batch.set_state(arrays["world"]))
        else:
            trainer.batch.seed(trainer.plan.seed + trainer.model.num_timesteps)
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        raise CoopenvError(f"{checkpoint.path}: does not fit: {error}; remove it to start anew") from None


def _arrays(trainer: Trainer) -> Arrays:
    moments = trainer.model.policy.optimizer.state_dict()["state"].items()
    _, key, position, *_ = np.random.get_state()
    begun = trainer.remembering and trainer.model._last_obs is not None
    remembered = {"memory": trainer.remembering.state.numpy()} if trainer.remembering and begun else {}
    groups: dict[str, Mapping[str, Any]] = {
        "policy": trainer.tensors(),
        "optimiser": {f"{index}/{name}": values.numpy() for index, row in moments for name, values in row.items()},
        "statistics": {"returns": trainer.env.returns, **remembered},
        "random": {"torch": torch.get_rng_state().numpy(), "numpy": np.append(key, np.uint32(position))},
        "world": _worlds(trainer),
    }
    return {
        f"{group}/{name}": np.array(values, order="C") for group, row in groups.items() for name, values in row.items()
    }


def _worlds(trainer: Trainer) -> Arrays:
    """Return the episodes under way; nothing where objects are part of them, so that new ones begin on resuming.

    Such are observers on the host, which are anybody's, and the environments of highway-env.
    """
    if trainer.batch.engine.plugins is not None:
        return {}
    state: Mapping[str, object] = trainer.batch.get_state()
    arrays = {name: values for name, values in state.items() if isinstance(values, np.ndarray)}
    return arrays if len(arrays) == len(state) else {}


def _tensors(arrays: Arrays) -> dict[str, torch.Tensor]:
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{name} is not finite")
    return {name: torch.from_numpy(values.copy()) for name, values in arrays.items()}
