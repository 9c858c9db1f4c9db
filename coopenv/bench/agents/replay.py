"""Pages that play the first world of an evaluation, one per driver; each leads to the others."""

import re
from contextlib import closing
from pathlib import Path

from rich.console import Console

from coopenv.api.engine import Engine
from coopenv.bench.agents.contest import Entrant, Evaluation
from coopenv.evaluation import held_out_seeds
from coopenv.runs.command import REPLAY_FILE
from coopenv.runs.console import Progress
from coopenv.runs.scenes import scene_of, write_page
from coopenv.viz.scene import Source

OTHERS = "replay_*.html"
"""Names of the pages but that of `shown_of`, which is `replay.html`."""


def write_replays(evaluation: Evaluation, folder: Path, log: Console) -> list[Path]:
    """Write the pages; none, and a line, where the extra `view` is missing."""
    files, seed = replay_files(evaluation), held_out_seeds(evaluation.block, evaluation.worlds)[0]
    written = []
    for entrant in sorted(evaluation.entrants, key=lambda e: e is not shown_of(evaluation)):
        source = Source.of(evaluation.environment, entrant.scenario, policy=entrant.name, seed=seed)
        with closing(Engine(entrant.scenario)) as engine, Progress(log, f"replay of {entrant.name}", 1.0) as progress:
            record = scene_of(engine, source, entrant.policy, progress.update)
        page = write_page(record, folder / files[entrant.name], log, files)
        if page is None:
            return []
        written.append(page)
    return written


def shown_of(evaluation: Evaluation) -> Entrant:
    """Return the driver whose page is `replay.html`: the first that has learnt, else the first of all."""
    return next((e for e in evaluation.entrants if e.kind == "learned"), evaluation.entrants[0])


def replay_files(evaluation: Evaluation) -> dict[str, str]:
    """Return the name of each driver's page, in the order of the drivers."""
    shown, files = shown_of(evaluation).name, dict[str, str]()
    for number, entrant in enumerate(evaluation.entrants):
        plain = re.sub(r"[^\w.-]+", "_", entrant.name)
        file = REPLAY_FILE if entrant.name == shown else OTHERS.replace("*", plain)
        files[entrant.name] = file if file not in files.values() else OTHERS.replace("*", f"{plain}_{number}")
    return files
