"""The trainings of a study: which are done, and doing one, in a process of its own. Needs the extra `train`."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

from coopenv.backends.sources import open_simulation
from coopenv.base.errors import CoopenvError
from coopenv.bench.learning.study import Run, Study
from coopenv.policies.loader import AGENT_FILE, CHECKPOINT_FILE, read_card
from coopenv.training.checkpoint import read
from coopenv.training.command import possible, train
from coopenv.training.export import scenario_digest
from coopenv.training.settings import SETTINGS_FILE, Plan, read_settings


@dataclass(frozen=True)
class Task:
    """One training as it is sent to another process."""

    plan: Plan
    out: Path
    logs: Path


def tasks(study: Study, folder: Path, logs: Path) -> list[Task]:
    """Return the trainings of a study that are not finished.

    Raises:
        CoopenvError: one of them is not possible: better now than when the others have been waited for.
    """
    runs = [run for run in study.runs if not is_finished(study, run, folder)]
    for run in runs:
        try:
            possible(study.plan(run))
        except CoopenvError as error:
            raise CoopenvError(f"{run.folder}: {error}") from None
    return [Task(study.plan(run), folder / run.folder, logs / run.folder) for run in runs]


def is_finished(study: Study, run: Run, folder: Path) -> bool:
    """Return whether a run's agent is there, trained as the study and its environment's file say now."""
    place, plan = folder / run.folder, study.plan(run)
    if not (place / AGENT_FILE).is_file() or not (place / SETTINGS_FILE).is_file():
        return False
    try:
        card, settings = read_card(place), read_settings(place / SETTINGS_FILE)
    except (CoopenvError, tomllib.TOMLDecodeError):
        return False
    known = [card.training.get(key) for key in ("environment", "seed", "arm", "scenario")]
    scenario = scenario_digest(open_simulation(plan.environment, plan.all_overrides))
    return known == [plan.environment, plan.seed, plan.arm, scenario] and settings == plan.settings


def perform(task: Task) -> None:
    """Train on one core, going on from a checkpoint where there is one of the same training.

    An agent that is there has been trained otherwise than the study says, and is replaced.

    Raises:
        CoopenvError: what `train` raises.
    """
    path = task.out / CHECKPOINT_FILE
    resume = path.is_file() and read(path).plan == task.plan
    if not resume:
        path.unlink(missing_ok=True)  # of a training with other settings
    task.logs.mkdir(parents=True, exist_ok=True)
    train(task.plan, task.out, resume=resume, threads=1, logs=task.logs, force=True)
