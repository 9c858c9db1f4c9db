"""Plan, results and statistics of the study: interquartile means and probabilities of improvement.

Source: Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, 2021 (both figures, and
resampling of runs within environments).
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field
from scipy.stats import trim_mean

from coopenv.base.errors import CoopenvError
from coopenv.base.files import replace_text
from coopenv.base.sections import Section, read_toml, validated
from coopenv.evaluation.metrics import interval, ranking_key
from coopenv.sources.sources import open_simulation

FIGURES = ("arrival_rate", "collision_rate", "travel_time_s", "e50_m", "e95_m", "return")
"""Of the metrics of `coopenv evaluate`, those that are kept."""
COLUMNS = ("environment", "method", "seed", "digest", "cpu_seconds", *FIGURES)
RESAMPLES = 4000


class Method(Section):
    """A method of the study."""

    about: str = ""
    """Description for the page."""
    learner: Literal["benchmarl", "coopenv", "offline"]
    options: dict[str, Any] = Field(default={})


class StudyFile(Section):
    """The contents of a study's TOML file."""

    decisions: int = Field(gt=0)
    """Of vehicles, that a run may learn from."""
    worlds: int = Field(gt=1)
    """Held-out ones in which a run is judged."""
    block: int = Field(ge=0)
    """Of the seeds of these worlds; runs of seed n have block + n."""
    seeds: tuple[int, ...] = Field(min_length=1)
    noise: float = Field(ge=0.0)
    """Standard deviation of what is added to the actions of recorded drivers."""
    environments: dict[str, str]
    """With the driver whose recordings are learned from."""
    references: tuple[str, ...] = ()
    """Scripted drivers that are shown beside the methods."""
    methods: dict[str, Method]


@dataclass(frozen=True)
class Run:
    """A training, or a drive of a scripted driver, of which results are kept."""

    environment: str
    method: str
    seed: int
    digest: str
    """Of all that its results depend on."""

    @property
    def key(self) -> tuple[str, ...]:
        """Its first columns."""
        return self.environment, self.method, str(self.seed), self.digest


def runs(study: StudyFile) -> list[Run]:
    """Return all runs, every method's first seed before any second one."""
    names = (*study.references, *study.methods)
    return [
        Run(*each, _digest(study, *each))
        for each in ((e, n, s) for s, e, n in product(study.seeds, study.environments, names))
    ]


def _digest(study: StudyFile, environment: str, name: str, seed: int) -> str:
    scenario = open_simulation(environment, {})
    known: list[Any] = [scenario.model_dump_json(exclude_defaults=True, exclude={"title", "description", "source"})]
    known += [study.worlds, study.block, name, seed]
    if method := study.methods.get(name):
        known += [study.decisions, method.model_dump(mode="json", exclude={"about"})]
        known += [study.environments[environment], study.noise] if method.learner == "offline" else []
    return sha256(json.dumps(known).encode()).hexdigest()[:12]


def read_study(path: Path) -> StudyFile:
    """Read a study.

    Raises:
        CoopenvError: it is not valid; one line that names file and key.
    """
    study = validated(StudyFile, read_toml(path), str(path))
    if both := sorted({*study.references} & {*study.methods}):
        raise CoopenvError(f"{path}: {both[0]} is a method and a reference: rename one")
    return study


Figures = dict[str, float]
Results = dict[Run, Figures]
"""Figures, and `cpu_seconds` of the training."""


def read_results(path: Path, wanted: Sequence[Run]) -> Results:
    """Return those results of a file that are of wanted runs.

    Raises:
        CoopenvError: it is no file of results.
    """
    if not path.is_file():
        return {}
    rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))
    by_key = {run.key: run for run in wanted}
    try:
        found = {tuple(row[name] for name in COLUMNS[:4]): row for row in rows}
        return {by_key[key]: _numbers(row) for key, row in found.items() if key in by_key}
    except (KeyError, ValueError, TypeError) as error:
        raise CoopenvError(f"{path}: expected the columns {', '.join(COLUMNS)} ({error})") from None


def _numbers(row: dict[str, str]) -> Figures:
    return {name: float(row[name]) for name in COLUMNS[4:]}


def write_results(path: Path, results: Results) -> None:
    """Write results, in the place of those before."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for run, figures in sorted(results.items(), key=lambda item: item[0].key):
        writer.writerow([*run.key, *(f"{figures[name]:.6g}" for name in COLUMNS[4:])])
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_text(path, text.getvalue())


def rank(figures: Figures) -> float:
    """Return a number that is larger for the better run, by the steps of losses and then e95, as `ranking_key`."""
    losses, e95, _ = ranking_key(figures)
    return 1.0 / (1.0 + e95) - losses


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean without the lowest and highest quarter along the last axis."""
    return np.asarray(trim_mean(values, 0.25, axis=-1))


def with_interval(values: np.ndarray, seed: int = 0) -> tuple[float, float, float]:
    """Return the interquartile mean of runs (S,) and its 95 % interval, by resampling runs."""
    drawn = np.random.default_rng(seed).choice(values, (RESAMPLES, len(values)))
    return float(interquartile_mean(values)), *interval(interquartile_mean(drawn))


def improvement(own: Sequence[np.ndarray], other: Sequence[np.ndarray], seed: int = 0) -> tuple[float, float, float]:
    """Return the probability that a run of a method is better than one of another, in the mean over environments.

    Args:
        own: ranks of the method's runs, an array per environment.
        other: those of the other method.
        seed: of the resampling, of runs within environments.

    Returns:
        The probability and its 95 % interval.
    """
    random = np.random.default_rng(seed)

    def probability(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        return np.asarray(np.mean([_larger(mine, theirs) for mine, theirs in pairs], axis=0))

    def drawn(values: np.ndarray) -> np.ndarray:
        return random.choice(values, (RESAMPLES, len(values)))

    value = probability(zip(own, other, strict=True))
    pairs = [(drawn(mine), drawn(theirs)) for mine, theirs in zip(own, other, strict=True)]
    return float(value), *interval(probability(pairs))


def _larger(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the share of pairs of the last axes whose first is larger, equal ones counted half."""
    difference = own[..., :, None] - other[..., None, :]
    return np.asarray(np.mean(0.5 + 0.5 * np.sign(difference), axis=(-1, -2)))
