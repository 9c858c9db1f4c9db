"""What a run has written, read again: its record, who it is about, and how it ended."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coopenv.base.errors import CoopenvError, DataError
from coopenv.estimation.trajectory import Trajectory
from coopenv.runs.command import METRICS_FILE, TRAJECTORY_FILE
from coopenv.scenario import Scenario, load_scenario

_NEEDED = ("environment", "seed", "policy", "overrides", "versions", "steady_from_s", "vehicles")


@dataclass(frozen=True)
class Results:
    """A folder of `coopenv run`."""

    folder: Path
    metrics: dict[str, Any]
    trajectory: Trajectory
    """Of the vehicles that were estimated, at the ticks at which their truth is known."""

    @classmethod
    def read(cls, folder: str | Path) -> "Results":
        """Read a folder.

        Raises:
            DataError: it is no folder of a run, or a file of it cannot be read.
        """
        folder = Path(folder)
        path = folder / METRICS_FILE
        try:
            metrics = json.loads(path.read_text(encoding="utf-8"))
        except NotADirectoryError:
            raise DataError(f"{folder}: a file; expected a folder that `coopenv run` has written") from None
        except OSError as error:
            raise DataError(f"{folder}: no folder of `coopenv run` ({METRICS_FILE}: {error.strerror})") from None
        except ValueError as error:
            raise DataError(f"{path}: not JSON ({error})") from None
        missing = [key for key in _NEEDED if not isinstance(metrics, dict) or key not in metrics]
        if missing:
            raise DataError(f"{path}: not of a run, missing: {', '.join(missing)}")
        whole = Trajectory.load(folder / TRAJECTORY_FILE)
        names = whole.vehicles.tolist()
        try:
            judged = [names.index(row["vehicle"]) for row in metrics["vehicles"]]
            metrics.setdefault("observer", "unknown observer")  # of a run before 0.2
            ends = [row["ended_at_s"] for row in metrics["vehicles"]]
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: vehicles are not those of {TRAJECTORY_FILE} ({error})") from None
        if not all(end is None or isinstance(end, float | int) for end in ends):
            raise DataError(f"{path}: ended_at_s: expected numbers")
        return cls(folder, metrics, whole.of_vehicles(judged).where_truth_is_known())

    @property
    def ends(self) -> list[float]:
        """When each vehicle ended, s; NaN: it did not."""
        return [math.nan if row["ended_at_s"] is None else float(row["ended_at_s"]) for row in self.metrics["vehicles"]]

    @property
    def steady_from(self) -> float:
        """Start of the steady state, s."""
        return float(self.metrics["steady_from_s"])

    def scenario(self) -> Scenario | None:
        """Return the world of the run; None where only its file could tell, such as of a recording."""
        try:
            return load_scenario(self.metrics["environment"], self.metrics["overrides"])
        except CoopenvError:
            return None
