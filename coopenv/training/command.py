"""`coopenv train`: learn, judge on held-out maps, keep checkpoints, and write the agent's folder. Needs `train`.

A checkpoint holds all that the next update depends on, in one file without pickle: a safetensors file of arrays, whose
header holds the plan, how far the training is, and its curve. It is replaced as a whole, so that a run that is killed
while writing keeps the one before.
"""

import json
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import closing
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
from coopenv.backends.sources import open_simulation
from coopenv.base import interrupts
from coopenv.base.errors import CoopenvError, OutputError, evaluation_seed
from coopenv.base.files import check_file, new_folder, replacing_file, replacing_folder, writing
from coopenv.evaluation import Result, drive, held_out_seeds, score
from coopenv.policies import load_agent
from coopenv.policies.loader import AGENT_FILE, CARD_FILES, CHECKPOINT_FILE
from coopenv.scenario import Scenario
from coopenv.training.export import EXPORTED, check_onnx, export
from coopenv.training.sets import SetTrainer
from coopenv.training.settings import TrainingPlan, check_settings, environment_file
from coopenv.training.trainer import DivergedError, Status, Trainer

NAMES = (*EXPORTED, CHECKPOINT_FILE, *CARD_FILES)
"""Names of files in an agent's folder; a card belongs to a single agent, and is removed with it."""
LOGS = "tensorboard"
WHILE_LEARNING = 2**30
"""Number of the first seed for evaluation that is looked at while learning; `coopenv evaluate` begins with number 0."""


KEPT_FOR = 60.0  # s of learning after which at the latest there is a checkpoint
FORMAT = 2
HEADER = "coopenv_checkpoint"
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Reports:
    """Callbacks of a training."""

    status: Callable[[Status], None] = lambda status: None
    """After every update."""
    judged: Callable[[int, list[Result]], None] = lambda steps, results: None
    """After every look at held-out maps: decisions of vehicles so far, and figures."""
    cloning: Callable[[str], None] = lambda line: None
    """Before the first update, where another driver is cloned: a line on the progress."""


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
        CoopenvError: no vehicle is driven there, a variation is not possible, or the driver to begin as lacks what it
            needs to see.
    """
    scenario = open_simulation(plan.environment, plan.all_overrides)
    if not any(scenario.acting):
        raise CoopenvError(f"{plan.environment}: all motion is prescribed or has a driver, there is nothing to learn")
    for own in plan.watched():
        try:
            for each, _ in own.scenarios():
                if plan.settings.clone is not None:
                    load_agent(plan.settings.clone.agent, each)
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
    if plan.settings.network and plan.settings.clone:
        cloned = SetTrainer(plan, scenario, plan.settings.clone, threads)
        cloned.begin(report.cloning)
        results = _judge(cloned, threads, report, held_out_seeds(0, plan.settings.evaluation.final_worlds))
        with replacing_folder(out, (*NAMES, environment.name, *environment.code)) as folder:
            export(folder, out, cloned, environment, results, [])
        return results
    curve = kept.curve if kept is not None else []
    with closing(Trainer(plan, scenario, threads)) as trainer:
        judge = partial(_judge, trainer, threads, report)
        with new_folder(out), new_folder(logs or out / LOGS) as tensorboard:
            check_file(path)
            trainer.model.set_logger(configure(str(tensorboard), ["tensorboard"]))
        if kept is not None:
            restore(kept, trainer)
        else:
            trainer.begin(report.cloning)
        try:
            _learn(trainer, curve, report, judge, partial(save, path, trainer, curve, onnx, logs))
            results = judge(held_out_seeds(0, plan.settings.evaluation.final_worlds))
        except DivergedError as error:
            if not path.is_file():
                raise
            left = f"{path} is kept as it was after {read(path).progress['steps']} steps"
            raise DivergedError(f"{error}; {left}, remove it to begin anew with other settings") from None
        with replacing_folder(out, (*NAMES, environment.name, *environment.code)) as folder:
            export(folder, out, trainer, environment, results, curve, onnx)
    return results


def _learn(
    trainer: Trainer,
    curve: list[dict[str, float]],
    report: Reports,
    judge: Callable[[list[int]], list[Result]],
    keep: Callable[[], None],
) -> None:
    """Update until the budget is spent; judge every so often. A checkpoint follows, or a minute's updates."""
    evaluation, kept = trainer.plan.settings.evaluation, trainer.seconds
    if trainer.status.steps == 0:
        keep()
    while trainer.status.share < 1.0:
        before = trainer.status.steps // evaluation.every
        status = trainer.update()
        report.status(status)
        due = status.steps // evaluation.every > before
        if due and status.share < 1.0:
            seeds = [evaluation_seed(WHILE_LEARNING + world) for world in range(evaluation.worlds)]
            means = {result.metric: result.mean for result in judge(seeds)}
            trainer.record(means)
            curve.append({"steps": status.steps, "seconds": round(status.seconds, 1), **means})
        if (due or status.seconds - kept > KEPT_FOR) and status.share < 1.0:
            kept = status.seconds
            keep()


def _judge(trainer: Trainer | SetTrainer, threads: int | None, report: Reports, seeds: list[int]) -> list[Result]:
    """Return the figures of the mean action in held-out worlds."""
    with closing(Engine(trainer.scenario, len(seeds), threads=threads)) as engine:
        results = score(drive(engine, trainer.mean_action, seeds))
    report.judged(trainer.status.steps, results)
    return results


class Checkpoint(BaseModel):
    """Contents of a checkpoint file."""

    model_config = ConfigDict(ser_json_inf_nan="constants")
    format: int = FORMAT
    plan: TrainingPlan
    scenario: str
    """JSON of the scenario, to find out whether it is still the same."""
    progress: dict[str, int | float]
    """`steps`, `seconds` and `cpu_seconds`."""
    curve: list[dict[str, int | float]]
    onnx: bool = False
    """Write an ONNX model, too, as on the command line."""
    logs: Path | None = None
    """Folder for TensorBoard; None: in the agent's folder."""
    path: Path = Field(default=Path(), exclude=True)
    arrays: dict[str, dict[str, Any]] = Field(default={}, exclude=True, repr=False)
    """Arrays by the object that they restore, and by name."""


def save(
    path: Path, trainer: Trainer, curve: list[dict[str, float]], onnx: bool = False, logs: Path | None = None
) -> None:
    """Write a checkpoint in the place of the one before.

    Raises:
        OutputError: it cannot be written; the one before is whole.
    """
    spent = {"seconds": trainer.seconds, "cpu_seconds": trainer.cpu_seconds}
    header = Checkpoint(
        plan=trainer.plan,
        scenario=trainer.scenario.model_dump_json(),
        progress={"steps": trainer.model.num_timesteps, **spent},
        curve=curve,
        onnx=onnx,
        logs=logs and logs.absolute(),
    )
    with replacing_file(path) as new, writing(path):
        try:
            save_file(_arrays(trainer), new, metadata={HEADER: header.model_dump_json()})
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
        return Checkpoint.model_validate({**header, "path": path, "arrays": arrays})
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
    policy, statistics, arrays = trainer.model.policy, trainer.env.statistics, checkpoint.arrays
    try:
        policy.load_state_dict(_tensors(arrays["policy"]), strict=True)
        moments: dict[int, dict[str, torch.Tensor]] = defaultdict(dict)
        for name, values in _tensors(arrays.get("optimiser", {})).items():
            index, _, moment = name.partition("/")
            moments[int(index)][moment] = values
        policy.optimizer.load_state_dict({**policy.optimizer.state_dict(), "state": moments})
        for name in ("mean", "var"):
            found = arrays["statistics"][name]
            if found.shape != statistics.mean.shape:
                raise ValueError(f"statistics/{name} has shape {found.shape}")
            setattr(statistics, name, found)
        statistics.count = float(arrays["statistics"]["count"])
        spread = arrays["statistics"]["spread"]
        trainer.env.spread.mean, trainer.env.spread.var, trainer.env.spread.count = spread
        trainer.env.returns[...] = arrays["statistics"]["returns"]
        torch.set_rng_state(torch.from_numpy(arrays["random"]["torch"]))
        key, position = np.split(arrays["random"]["numpy"], [-1])
        np.random.set_state({"bit_generator": "MT19937", "state": {"key": key, "pos": int(position[0])}})
        trainer.model.num_timesteps = int(checkpoint.progress["steps"])
        trainer.seconds, trainer.cpu_seconds = checkpoint.progress["seconds"], checkpoint.progress["cpu_seconds"]
        if "world" in arrays:
            trainer.env.go_on_from(trainer.batch.set_state(arrays["world"]))
        else:
            trainer.batch.seed(trainer.plan.seed + trainer.model.num_timesteps)
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        raise CoopenvError(f"{checkpoint.path}: does not fit: {error}; remove it to start anew") from None


def _arrays(trainer: Trainer) -> Arrays:
    policy, statistics = trainer.model.policy, trainer.env.statistics
    moments = policy.optimizer.state_dict()["state"].items()
    _, key, position, *_ = np.random.get_state()
    groups: dict[str, Mapping[str, Any]] = {
        "policy": {name: values.numpy() for name, values in policy.state_dict().items()},
        "optimiser": {f"{index}/{name}": values.numpy() for index, row in moments for name, values in row.items()},
        "statistics": {
            **{name: getattr(statistics, name) for name in ("mean", "var", "count")},
            "spread": np.array([getattr(trainer.env.spread, name) for name in ("mean", "var", "count")], dtype=float),
            "returns": trainer.env.returns,
        },
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
