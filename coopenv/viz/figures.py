"""All figures of a run, written as PNG files under stable names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from matplotlib.figure import Figure

from coopenv.errors import OutputError
from coopenv.estimation.observability import Observability, analyse_observability
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz.consistency import consistency_figure
from coopenv.viz.errors import error_figure
from coopenv.viz.observability import observability_figure
from coopenv.viz.style import save
from coopenv.viz.topology import topology_figure
from coopenv.viz.trajectories import trajectory_figure_2d, trajectory_figure_3d

FIGURES: dict[str, Callable[[Trajectory], Figure]] = {
    "errors.png": error_figure,
    "trajectories_2d.png": trajectory_figure_2d,
    "trajectories_3d.png": trajectory_figure_3d,
    "topology.png": topology_figure,
    "consistency.png": consistency_figure,
}


def save_figures(
    trajectory: Trajectory, directory: str | Path, observability: Observability | None = None
) -> list[Path]:
    """Write the figures of `FIGURES` and `observability.png` into `directory`, which is made if need be.

    Args:
        trajectory: the record of a run.
        directory: where the files go; files of the same names are replaced.
        observability: evaluated here with the default window and threshold unless given.

    Returns:
        The paths written.

    Raises:
        OutputError: the directory cannot be made or written to.
    """
    directory = Path(directory)
    if observability is None:
        observability = analyse_observability(trajectory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        paths = [save(draw(trajectory), directory / name) for name, draw in FIGURES.items()]
        paths.append(save(observability_figure(observability), directory / "observability.png"))
    except OSError as error:
        raise OutputError(f"{directory}: cannot write figures ({error.strerror or error})") from None
    return paths
