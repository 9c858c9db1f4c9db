"""Frozen benchmarks, `coopenv bench v1`: scenes, seeds and limits that do not change, and the rows of the zoo.

`v1.toml` defines scenes, seeds and limits. `v1_actions.npz` has the actions of driven vehicles, so that records do not
depend on drivers, which may change. `v1.json` is the result file of the zoo: results are comparable if their hashes and
figures of records agree with it.
"""

import json
import math
import tomllib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from coopenv.base.errors import CoopenvError, ScenarioWarning, check_one_of, listed
from coopenv.base.format import in_parentheses, jsonable, number
from coopenv.base.installation import data_directory, versions
from coopenv.bench.executors import Local, ProcessLimits, check_imports
from coopenv.bench.observers.comparison import Comparison, Plan
from coopenv.bench.observers.faults import NOMINAL
from coopenv.bench.observers.judge import Task, judge_all
from coopenv.bench.observers.rows import median_of, spread
from coopenv.bench.observers.sources import SimulatedRecords, find_source
from coopenv.bench.observers.tables import mean_of, short_name
from coopenv.estimation.metrics import DIVERGED_POSITION
from coopenv.observers.isolation import Isolated, load
from coopenv.observers.registry import check_known, find, list_observers, zoo
from coopenv.runs.console import number_table

FOLDER = Path(__file__).parent
TOLERANCE = 1e-3
"""Relative, of the figures of records: other processors round differently."""
LEAST_SHARE = 0.9
"""Least error of a row, as a share of the bound, or of the best shipped row where it is below the bound."""
LEAST_ANEES = 0.16
"""Least median of the ANEES over scenes: the quantile 1e-6 of chi-square with 24 degrees of freedom, 6 per seed."""
COSTS = ("anees_median", "anees_worst", "bytes_per_s", "us_per_update")
"""Columns whose totals are medians over the scenes."""
SHOWN = ("robust", "schmidt_kalman")
"""Observers of the zoo beside the new one in the table of scenes."""


class FrozenScene(NamedTuple):
    """One scene of a benchmark."""

    name: str
    source: SimulatedRecords
    variant: str
    hash: str
    """Hash of its scenario, fault, policy or actions, and seeds."""


@dataclass(frozen=True)
class Frozen:
    """A version of the benchmark."""

    version: str

    @cached_property
    def _text(self) -> str:
        return (FOLDER / f"{self.version}.toml").read_text(encoding="utf-8")

    @cached_property
    def definition(self) -> dict[str, Any]:
        """Definition of the benchmark's measurement."""
        return tomllib.loads(self._text)

    @cached_property
    def zoo(self) -> dict[str, Any]:
        """The result file that ships with coopenv; without rows before the version is frozen."""
        path = FOLDER / f"{self.version}.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {"rows": [], "scenes": {}}

    @cached_property
    def actions(self) -> dict[str, np.ndarray]:
        """Actions (seeds, decisions, vehicles, A), float16 in [-1, 1], by driven scene; none before `freeze`."""
        path = FOLDER / f"{self.version}_actions.npz"
        if not path.is_file():
            return {}
        with np.load(path, allow_pickle=False) as archive:
            return dict(archive)

    @property
    def seeds(self) -> range:
        """Seeds of every scene."""
        first = self.definition["first"]
        return range(first, first + self.definition["seeds"])

    @property
    def limits(self) -> ProcessLimits:
        """Limits of every observer."""
        return ProcessLimits(self.definition["seconds"], self.definition["memory"])

    def scenes(self, names: Sequence[str] = ()) -> list[FrozenScene]:
        """Return scenes by name, without names all of them. Raises CoopenvError: there is none of a name."""
        defined = {about["name"]: about for about in self.definition["scenes"]}
        for name in names:
            check_one_of("unknown scene", name, defined)
        with warnings.catch_warnings(action="ignore", category=ScenarioWarning):  # scenes are as they are
            return [self._scene(about) for name, about in defined.items() if not names or name in names]

    def _scene(self, about: Mapping[str, Any]) -> FrozenScene:
        fault, policy = about.get("fault", ""), about.get("policy")
        source = find_source(about["environment"], about.get("set"), faults=[fault] * bool(fault), policy=policy)
        assert isinstance(source, SimulatedRecords)
        variant = source.added[0] if fault else source.fault(NOMINAL)
        driven_by: Any = policy
        if (actions := self.actions.get(about["name"])) is not None:
            source = replace(source, actions=dict(zip(self.seeds, actions.astype(np.float64), strict=True)))
            driven_by = sha256(actions.tobytes()).hexdigest()
        unused = {"title", "description", "source", "observation", "reward"}  # records do not depend on these
        world = (variant.scenario or source.scenario).model_dump(mode="json", exclude_unset=True, exclude=unused)
        text = json.dumps([world, driven_by, fault, [*self.seeds]], sort_keys=True)
        return FrozenScene(about["name"], source, variant.name, sha256(text.encode()).hexdigest())

    def run(
        self,
        observers: Sequence[str],
        names: Sequence[str],
        jobs: int,
        limits: ProcessLimits,
        on_progress: Callable[[float], None],
    ) -> dict[str, Any]:
        """Return the content of the result file of observers in some scenes, all without names."""
        scenes, share, executor = self.scenes(names), self.definition["steady_from"], Local(jobs, limits)
        chosen = _by_name(observers)
        own = {name: observer for name, observer in chosen.items() if name not in zoo()}
        loaded = dict(zip(own, check_imports(executor, [*own.values()], load), strict=True))
        files = {name: digest for name, (_, digest) in loaded.items()}
        sent = {name: Isolated(observer) if name in own else observer for name, observer in chosen.items()}
        steady = {s.name: share * s.source.scenario.horizon for s in scenes}
        tasks = [Task(s.source, s.variant, seed, sent, steady[s.name]) for s in scenes for seed in self.seeds]
        plans = {s.name: Plan(s.source, (*sent,), (s.variant,), (*self.seeds,), None) for s in scenes}
        judged = iter(judge_all(executor, tasks, lambda done: on_progress(done / len(tasks))))
        boards = {name: plan.compared(islice(judged, len(self.seeds))) for name, plan in plans.items()}
        found = {s.name: {"hash": s.hash, "records": _figures(boards[s.name])} for s in scenes}
        joint = {name for name in chosen if (loaded[name][0] if name in own else hasattr(find(name), "joint"))}
        rows = [row_of(name, board, one, one in joint) for name, board in boards.items() for one in board.observers]
        refused = self.refused(rows)
        rows = [row for row in rows if row["observer"] not in refused]
        remarks = [*refused.values(), *self._remarks(found, limits)]
        result = {
            "benchmark": self.version,
            "definition": self.digest,
            "comparable": not remarks,
            "remarks": remarks,
            "versions": versions("coopenv", "numpy", "scipy", "warp-lang", "numba"),
            "code": {"package": package_digest(), **files},
            "limits": {"seconds": limits.seconds, "memory": limits.mebibytes},
            "seeds": [*self.seeds],
            "scenes": found,
            "rows": rows,
            "refused": refused,
            "totals": totals_of(rows),
        }
        return dict(jsonable(result))

    @property
    def digest(self) -> str:
        """SHA-256 of the definition."""
        return sha256(self._text.encode()).hexdigest()

    def refused(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
        """Return why observers of users are refused: errors, or a NEES, that measurements do not make possible."""
        least: dict[str, float] = {}
        for row in self.zoo["rows"]:
            least[row["scene"]] = min(row["rmse_m"], least.get(row["scene"], math.inf))
        refused = {}
        for observer in sorted({row["observer"] for row in rows} - zoo().keys()):
            own = [row for row in rows if row["observer"] == observer and not row["failure"]]
            if (anees := median_of(row["anees_median"] for row in own)) < LEAST_ANEES:  # NaN: none is stated
                why = f"ANEES {anees:.2g} is below {LEAST_ANEES:g}: state a smaller covariance, or none"
                refused[observer] = f"{observer} refused: {why}"
            for row in own:
                limits = {"the bound": row["bound_m"], "the best shipped row": least.get(row["scene"], math.inf)}
                what = min(limits, key=lambda name: limits[name])
                if row["rmse_m"] < (limit := LEAST_SHARE * limits[what]):
                    why = f"{row['rmse_m']:.2g} m in {row['scene']} is below {limit:.2g} m"
                    refused[observer] = f"{observer} refused: {why}, {LEAST_SHARE:g} of {what}"
        return refused

    def _remarks(self, found: Mapping[str, Any], limits: ProcessLimits) -> list[str]:
        """Return why a result is not comparable with that of the zoo; empty where it is."""
        remarks, frozen = [], self.zoo["scenes"]
        if self.digest != self.zoo.get("definition"):
            remarks.append(f"{self.version}.toml is not that of the shipped rows")
        if missing := len(self.definition["scenes"]) - len(found):
            remarks.append(f"{missing} scenes were left out")
        if limits != self.limits:
            remarks.append(f"limits {limits.seconds:g} s and {limits.mebibytes:g} MiB")
        for name, scene in found.items():
            if scene["hash"] != frozen.get(name, {}).get("hash"):
                remarks.append(f"scene {name}: its scenario is not the frozen one")
            elif not np.allclose(scene["records"], frozen[name]["records"], rtol=TOLERANCE):
                remarks.append(f"scene {name}: its records are not the frozen ones")
        return remarks


def _by_name(observers: Sequence[str]) -> dict[str, str]:
    """Return observers by name, without running their code. Raises CoopenvError: unknown, or two of one name."""
    chosen: dict[str, str] = {}
    for observer in dict.fromkeys(observers):
        check_known(observer)
        place, colon, name = observer.rpartition(":")
        if name in {*chosen, *(list_observers() if colon else ())}:
            name = f"{Path(place.removesuffix('.py').replace('.', '/')).name}.{name}"
        if name in chosen:
            raise CoopenvError(f"two observers are named '{name}': rename the class")
        chosen[name] = observer
    return chosen


def _figures(board: Comparison) -> list[float]:
    """Return the mean figures of the records of all seeds."""
    figures = [sample.scene.figures for sample in board.samples if sample.observer == board.observers[0]]
    return [float(f"{value:.7g}") for value in np.mean(figures, axis=0)]


def row_of(scene: str, board: Comparison, observer: str, joint: bool) -> dict[str, Any]:
    """Return the row of one observer in one scene; null where it failed. A joint one has another bound."""
    variant = next(iter(board.variants))
    rows = board.rows_in(variant, observer)
    rmse, position, anees = board.totals[variant, observer].rmse, spread(rows, "position_rmse_m"), spread(rows, "anees")
    return {
        "scene": scene,
        "observer": observer,
        "rmse_m": rmse.value,
        "rmse_se_m": rmse.error,
        "median_m": position.median,
        "worst_m": position.worst,
        "worst_se_m": position.error,
        "worst_vehicle": position.vehicle,
        "orientation_deg": mean_of(rows, "orientation_rmse_deg"),
        "bound_m": mean_of(rows, "bound_m" if joint else "bound_ancestors_m"),
        "anees_median": anees.median,
        "anees_worst": anees.worst,
        "bytes_per_s": mean_of(rows, "bytes_per_s"),
        "us_per_update": mean_of(rows, "us_per_update"),
        "failure": next((row.failure for row in rows if row.failure), ""),
    }


def totals_of(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of all scenes summed up, one per observer, the most accurate first.

    Positions are geometric means over the scenes, in which an error above 5 m, or a failure, counts as 5 m.
    """
    totals = []
    for observer in dict.fromkeys(row["observer"] for row in rows):
        own = [row for row in rows if row["observer"] == observer]
        error = {key: np.array([_limited(row[key]) for row in own]) for key in ("rmse_m", "median_m", "worst_m")}
        spreads = [row["rmse_se_m"] / e for row, e in zip(own, error["rmse_m"], strict=True) if e < DIVERGED_POSITION]
        whole = [row for row in own if not row["failure"]]
        means = {key: math.exp(np.log(values).mean()) for key, values in error.items()}
        totals.append(
            {
                "observer": observer,
                **means,
                "rmse_se_m": means["rmse_m"] * float(np.sqrt(np.square(spreads).sum())) / len(own),
                "above": sum(1 for row in whole if _limited(row["rmse_m"]) == DIVERGED_POSITION),
                "failed": len(own) - len(whole),
                **{key: median_of(row[key] for row in whole) for key in COSTS},
            }
        )
    return sorted(totals, key=lambda total: total["rmse_m"])


def _limited(value: float | None) -> float:
    return DIVERGED_POSITION if value is None or not value < DIVERGED_POSITION else max(value, 1e-9)


def report(benchmark: Frozen, result: Mapping[str, Any]) -> Iterator[Table | str]:
    """Yield the totals and the errors by scene, with the zoo's, failures, and remarks."""
    own = {row["observer"] for row in result["rows"]}
    zoo = [row for row in benchmark.zoo["rows"] if row["scene"] in result["scenes"] and row["observer"] not in own]
    numbers = ["RMSE\n[m]", "median\nvehicle", "worst\nvehicle", "above\n5 m", "failed", "\nANEES", "worst\nANEES"]
    totals = number_table([f"bench {benchmark.version}"], [*numbers, "sent\nB/s", "\nus"])
    for total in totals_of([*result["rows"], *zoo]):
        figures = [number(total[key], 3) for key in ("median_m", "worst_m")]
        counts = [str(total[key]) for key in ("above", "failed")]
        costs = [number(total[key], 2) for key in COSTS]
        mark = "* " if total["observer"] in own else ""
        error = in_parentheses(total["rmse_m"], total["rmse_se_m"])
        totals.add_row(mark + total["observer"], error, *figures, *counts, *costs)
    yield totals
    yield f"*: new. Geometric means over {len(result['scenes'])} scenes; failures and errors above 5 m count as 5 m.\n"
    names = [*own, *(name for name in SHOWN if any(row["observer"] == name for row in zoo))]
    cells = {(row["scene"], row["observer"]): row for row in [*zoo, *result["rows"]]}
    scenes = number_table(["RMSE [m]"], ["bound", *map(short_name, names)])
    for scene in result["scenes"]:
        of = [cells[scene, name] for name in names]
        errors = ["failed" if row["failure"] else in_parentheses(row["rmse_m"], row["rmse_se_m"]) for row in of]
        scenes.add_row(scene, "-" if of[0]["bound_m"] is None else number(of[0]["bound_m"], 3), *errors)
    yield scenes
    failures: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in result["rows"]:
        if row["failure"]:
            failures.setdefault((row["observer"], row["failure"].partition(": ")[2]), []).append(row)
    for (observer, _), rows in failures.items():
        yield f"{observer} ({listed([row['scene'] for row in rows], 3)}): failed {rows[0]['failure']}"
    if result["remarks"]:
        yield f"Not comparable with the zoo's rows: {listed(result['remarks'], 4)}"


def package_digest() -> str:
    """Return a digest of the code and the data of the package that is running."""
    digest = sha256()
    for folder in (Path(__file__).parents[1], data_directory("envs"), data_directory("agents")):
        for path in sorted(path for kind in ("py", "toml", "safetensors") for path in folder.rglob(f"*.{kind}")):
            digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()
