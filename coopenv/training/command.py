"""`coopenv train`: learn, judge on held-out maps, keep checkpoints, and write the agent's folder. Needs `train`."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from coopenv.api.engine import Engine
from coopenv.backends.sources import open_simulation
from coopenv.base import interrupts
from coopenv.base.errors import CoopenvError, OutputError, evaluation_seed
from coopenv.base.files import check_file, new_folder, replacing_folder
from coopenv.evaluation import Result, drive, held_out_seeds, score
from coopenv.policies import load_agent
from coopenv.policies.loader import AGENT_FILE, CARD_FILES, CHECKPOINT_FILE
from coopenv.scenario import Scenario
from coopenv.training import checkpoint, files
from coopenv.training.export import EXPORTED, check_onnx, export
from coopenv.training.files import environment_file
from coopenv.training.settings import Plan
from coopenv.training.trainer import DivergedError, Status, Trainer

NAMES = (*EXPORTED, CHECKPOINT_FILE, *CARD_FILES)
"""Names of files in an agent's folder; a card belongs to a single agent, and is removed with it."""
LOGS = "tensorboard"
WHILE_LEARNING = 2**30
"""Number of the first seed for evaluation that is looked at while learning; `coopenv evaluate` begins with number 0."""


@dataclass(frozen=True)
class Reports:
    """Callbacks of a training."""

    status: Callable[[Status], None] = lambda status: None
    """After every update."""
    judged: Callable[[int, list[Result]], None] = lambda steps, results: None
    """After every look at held-out maps: decisions of vehicles so far, and figures."""
    cloning: Callable[[str], None] = lambda line: None
    """Before the first update, where another driver is cloned: a line on the progress."""


def resumed_plan(out: Path) -> Plan:
    """Return the plan of the unfinished training in a folder.

    Raises:
        CoopenvError: there is none, or its checkpoint is damaged.
    """
    if not (out / CHECKPOINT_FILE).is_file() and (out / AGENT_FILE).is_file():
        raise CoopenvError(f"nothing to resume: {out} holds a finished agent and no checkpoint")
    return checkpoint.read(out / CHECKPOINT_FILE).plan


def possible(plan: Plan) -> Scenario:
    """Return the scenario of a training, before anything is made.

    Raises:
        CoopenvError: no vehicle is driven there, or the driver to begin as lacks what it needs to see.
    """
    scenario = open_simulation(plan.environment, plan.all_overrides)
    if not scenario.driven:
        raise CoopenvError(f"{plan.environment}: all motion here is prescribed, there is nothing to learn")
    if plan.settings.clone is not None:
        load_agent(plan.settings.clone.agent, scenario)
    return scenario


def train(
    plan: Plan,
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
        plan: what to train.
        out: the agent's folder.
        resume: go on from the folder's checkpoint, which is of the same plan, and with the outputs that it began with.
        threads: shares of the batch on the CPU; results do not depend on it.
        onnx: also write an ONNX model.
        logs: folder for TensorBoard.
        force: let the new agent, once it is finished, take the place of one that is there.
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
    scenario = possible(plan)
    kept = checkpoint.read(path) if resume else None
    if kept is None and path.is_file():
        raise CoopenvError(f"{out} holds an unfinished training: go on with --resume, or remove {path}")
    if kept is None and (out / AGENT_FILE).exists() and not force:
        raise OutputError(f"{out / AGENT_FILE}: exists already; --force replaces the agent")
    files.check(out, plan, environment_file(plan.environment).name)
    outputs = checkpoint.Outputs(onnx, logs)
    if kept is not None:
        outputs = outputs.or_else(kept.outputs)
    if outputs.onnx:
        check_onnx()
    trainer = Trainer(plan, scenario, threads)
    curve = kept.curve if kept is not None else []
    try:
        with new_folder(out), new_folder(outputs.logs or out / LOGS) as tensorboard:
            check_file(path)
            trainer.log_to(str(tensorboard))
        if kept is not None:
            checkpoint.restore(kept, trainer)
        else:
            trainer.begin(report.cloning)
        worlds = plan.settings.evaluation.final_worlds
        with _kept_from_before(path):
            _learn(trainer, path, curve, outputs, threads, report)
            results = _judge(trainer, held_out_seeds(0, worlds), threads, report)
        with replacing_folder(out, (*NAMES, trainer.environment.name)) as folder:
            files.write(folder, out, plan, trainer.environment.name)
            export(folder, trainer, results, curve, outputs.onnx)
    finally:
        trainer.close()
    return results


@contextmanager
def _kept_from_before(path: Path) -> Iterator[None]:
    """Say where a training that diverges has left its last checkpoint."""
    try:
        yield
    except DivergedError as error:
        if not path.is_file():
            raise
        kept = f"{path} is kept as it was after {checkpoint.read(path).progress['steps']} steps"
        raise DivergedError(f"{error}; {kept}, remove it to begin anew with other settings") from None


def _learn(
    trainer: Trainer,
    path: Path,
    curve: list[dict[str, float]],
    outputs: checkpoint.Outputs,
    threads: int | None,
    report: Reports,
) -> None:
    """Update until the budget is spent; judge and write a checkpoint every so often."""
    evaluation = trainer.plan.settings.evaluation
    if not path.is_file():
        _save(trainer, path, curve, outputs)
    while trainer.status.share < 1.0:
        before = trainer.status.steps // evaluation.every
        status = trainer.update()
        report.status(status)
        if status.steps // evaluation.every > before and status.share < 1.0:
            seeds = [evaluation_seed(WHILE_LEARNING + world) for world in range(evaluation.worlds)]
            means = {result.metric: result.mean for result in _judge(trainer, seeds, threads, report)}
            trainer.record(means)
            curve.append({"steps": status.steps, "seconds": round(status.seconds, 1), **means})
            _save(trainer, path, curve, outputs)


def _save(trainer: Trainer, path: Path, curve: list[dict[str, float]], outputs: checkpoint.Outputs) -> None:
    checkpoint.save(path, trainer, curve, outputs)
    interrupts.note(f"kept: {path} after {trainer.status.steps} steps; go on with --resume")


def _judge(trainer: Trainer, seeds: list[int], threads: int | None, report: Reports) -> list[Result]:
    """Return how the mean action drives in held-out worlds."""
    engine = Engine(trainer.scenario, len(seeds), threads=threads)
    try:
        results = score(drive(engine, trainer.mean_action, seeds))
    finally:
        engine.close()
    report.judged(trainer.status.steps, results)
    return results
