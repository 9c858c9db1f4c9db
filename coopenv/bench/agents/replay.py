"""The page that plays the first world of an evaluation under one of its drivers."""

from contextlib import closing
from pathlib import Path

from rich.console import Console

from coopenv.api.engine import Engine
from coopenv.bench.agents.contest import Entrant, Evaluation
from coopenv.evaluation import held_out_seeds
from coopenv.runs.console import Progress
from coopenv.runs.scenes import scene_of, write_page
from coopenv.viz.scene import Source


def write_replay(evaluation: Evaluation, path: Path, log: Console) -> Path | None:
    """Write the page; None, and a line, where the extra `view` is missing."""
    entrant, seed = shown_of(evaluation), held_out_seeds(evaluation.block, evaluation.worlds)[0]
    source = Source.of(evaluation.environment, entrant.scenario, policy=entrant.name, seed=seed)
    with closing(Engine(entrant.scenario)) as engine, Progress(log, f"replay of {entrant.name}", 1.0) as progress:
        record = scene_of(engine, source, entrant.policy, progress.update)
    return write_page(record, path, log)


def shown_of(evaluation: Evaluation) -> Entrant:
    """Return the driver that the page shows: the first that has learnt, else the first of all."""
    return next((e for e in evaluation.entrants if e.kind == "learned"), evaluation.entrants[0])
