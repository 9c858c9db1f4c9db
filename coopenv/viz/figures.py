"""All figures of a run, written under stable names."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from coopenv.base.errors import CoopenvError, suggest
from coopenv.base.files import writing
from coopenv.estimation.observability import Observability, analyse_observability
from coopenv.estimation.trajectory import Trajectory
from coopenv.scenario import Scenario
from coopenv.viz import FIGURE_NAMES, paper
from coopenv.viz.consistency import consistency_figure
from coopenv.viz.error_figure import error_figure
from coopenv.viz.observability import observability_figure
from coopenv.viz.style import save, sign
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
    about: Mapping[str, object] | None = None,
    width: str | float | None = None,
    gain: bool = False,
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
        note: in small print below each figure: what it is of.
        about: what metadata of the files say: environment, observer, seed.
        width: a column of `coopenv.viz.paper.COLUMNS`, whose fonts the figures then have, or inches (None: a page's).
        gain: whether P is a gain matrix and no covariance.

    Raises:
        OutputError: the directory cannot be made or written to.
        CoopenvError: no such format or column.
    """
    directory = Path(directory)
    inches = paper.inches_of(width)
    drawings = _drawings(trajectory, observability, scenario, ends, steady_from, gain, inches)
    with writing(directory):
        directory.mkdir(parents=True, exist_ok=True)
    paths = []
    for name in FIGURE_NAMES:
        figure = drawings[name]()
        sign(figure, note)
        if isinstance(width, str):
            paper.restyle(figure, width)
        paths.append(
            save(figure, directory / f"{name}.{file_format}", about=about or ({"About": note} if note else {}))
        )
    return paths


def draw_figure(
    name: str,
    trajectory: Trajectory,
    *,
    scenario: Scenario | None = None,
    ends: Sequence[float] | None = None,
    steady_from: float | None = None,
    width: str | float | None = None,
    gain: bool = False,
) -> Figure:
    """Return one figure of a run; arguments as for `save_figures`.

    Raises:
        CoopenvError: no figure or column of that name.
    """
    drawings = _drawings(trajectory, None, scenario, ends, steady_from, gain, paper.inches_of(width))
    if name not in drawings:
        raise CoopenvError(f"unknown figure '{name}'{suggest(name, drawings)}; known: {', '.join(drawings)}")
    figure = drawings[name]()
    return paper.restyle(figure, width) if isinstance(width, str) else figure


def _drawings(
    trajectory: Trajectory,
    observability: Observability | None,
    scenario: Scenario | None,
    ends: Sequence[float] | None,
    steady_from: float | None,
    gain: bool,
    width: float | None,
) -> dict[str, Callable[[], Figure]]:
    """Return how each figure is drawn, by name."""

    def seen() -> Observability:
        return analyse_observability(trajectory) if observability is None else observability

    return {
        "errors": lambda: error_figure(trajectory, ends, width),
        "trajectories_2d": lambda: trajectory_figure_2d(trajectory, ends, scenario, width),
        "trajectories_3d": lambda: trajectory_figure_3d(trajectory, ends, scenario, width),
        "topology": lambda: topology_figure(trajectory, ends, width),
        "consistency": lambda: consistency_figure(trajectory, ends, steady_from, width, gain=gain),
        "observability": lambda: observability_figure(seen(), ends, width),
    }
