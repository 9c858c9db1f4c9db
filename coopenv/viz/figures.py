"""All figures of a run, written under stable names."""

from collections.abc import Sequence
from pathlib import Path

from coopenv.estimation.observability import Observability, analyse_observability
from coopenv.estimation.trajectory import Trajectory
from coopenv.files import writing
from coopenv.scenario import Scenario
from coopenv.viz import FIGURE_NAMES
from coopenv.viz.consistency import consistency_figure
from coopenv.viz.error_figure import error_figure
from coopenv.viz.observability import observability_figure
from coopenv.viz.style import save
from coopenv.viz.topology import topology_figure
from coopenv.viz.trajectories import trajectory_figure_2d, trajectory_figure_3d


def save_figures(
    trajectory: Trajectory,
    directory: str | Path,
    observability: Observability | None = None,
    *,
    scenario: Scenario | None = None,
    ends: Sequence[float] | None = None,
    steady_from: float | None = None,
    file_format: str = "png",
    note: str = "",
) -> list[Path]:
    """Write the figures of `FIGURE_NAMES` into `directory`, which is made if need be, and return their paths.

    Args:
        trajectory: the record of a run.
        directory: where the files go; files of the same names are replaced.
        observability: with the default window and threshold unless given.
        scenario: of the run, for the roads and buildings under its paths.
        ends: s, when each vehicle arrived or collided and was parked, where its lines stop (None: no vehicle was).
        steady_from: s, start of the steady state that mean NEES are over (None: at 70 % of the record).
        file_format: one of `FORMATS`.
        note: in small print in the corner of each figure: what it is of.

    Raises:
        OutputError: the directory cannot be made or written to.
    """
    directory = Path(directory)
    seen = analyse_observability(trajectory) if observability is None else observability
    draw = {
        "errors": lambda: error_figure(trajectory, ends),
        "trajectories_2d": lambda: trajectory_figure_2d(trajectory, ends, scenario),
        "trajectories_3d": lambda: trajectory_figure_3d(trajectory, ends, scenario),
        "topology": lambda: topology_figure(trajectory, ends),
        "consistency": lambda: consistency_figure(trajectory, ends, steady_from),
        "observability": lambda: observability_figure(seen, ends),
    }
    with writing(directory):
        directory.mkdir(parents=True, exist_ok=True)
    return [save(draw[name](), directory / f"{name}.{file_format}", note=note) for name in FIGURE_NAMES]
