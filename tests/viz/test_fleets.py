"""Figures and tables of a large fleet show the vehicles of the largest errors alone, and say so."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from coopenv.estimation.metrics import MOST_SHOWN, shown_note, shown_vehicles, summarise
from coopenv.estimation.observability import analyse_observability
from coopenv.estimation.trajectory import Trajectory
from coopenv.runs.command import Results
from coopenv.viz import FIGURE_NAMES
from coopenv.viz.figures import draw_figure, save_figures
from coopenv.viz.trajectories import trajectory_figure_2d
from tests.helpers.drawn import texts
from tests.helpers.synthetic import make_trajectory

COPIES, LANDMARKS = 4, 3
NOTE = "12 worst of 20 vehicles, by RMSE of the position"


@pytest.fixture(scope="module")
def fleet() -> Trajectory:
    """Twenty vehicles, copies of five with errors of their own size."""
    run = make_trajectory(ticks=300, noise=0.02)
    count = 5 * COPIES
    names = np.array([f"vehicle_{i + 1}" for i in range(count)])
    targets = [*range(LANDMARKS), *[LANDMARKS + i for i in range(5)] * COPIES]
    size = np.random.default_rng(3).permutation(count) + 1.0
    run = run.of_vehicles([*range(5)] * COPIES)
    return dataclasses.replace(
        run,
        position_error=np.tile(np.exp(-run.t)[:, None], count) * size,
        vehicles=names,
        targets=np.concatenate([run.targets[:LANDMARKS], names]),
        **{
            name: getattr(run, name)[..., targets, :] if name == "target_position" else getattr(run, name)[..., targets]
            for name in ("target_position", "target_moving", "visible", "sight")
        },
    )


def test_the_largest_errors_of_the_steady_state_are_shown(fleet: Trajectory) -> None:
    """An estimate that is lost is the worst of all; vehicles that end before follow, by their last error."""
    sizes = fleet.position_error[0]
    assert shown_vehicles(fleet, 2.0) == np.argsort(-sizes)[:MOST_SHOWN].tolist()
    best = int(np.argmin(sizes))
    error = fleet.position_error.copy()
    error[-1, best] = np.nan
    lost = dataclasses.replace(fleet, position_error=error)
    assert shown_vehicles(lost, 2.0)[0] == best
    worst = int(np.argmax(sizes))
    ends = [1.0 if i == worst else np.nan for i in range(len(sizes))]
    assert worst not in shown_vehicles(fleet, 2.0, ends)
    assert shown_vehicles(fleet, 9.0) == np.argsort(-sizes)[:MOST_SHOWN].tolist()
    few = fleet.of_vehicles(range(MOST_SHOWN))
    assert shown_vehicles(few, 2.0) == [*range(MOST_SHOWN)] and shown_note(MOST_SHOWN) == ""


def test_figures_show_them_and_say_so(fleet: Trajectory, unwritten: list[Figure], tmp_path: Path) -> None:
    save_figures(fleet, tmp_path, analyse_observability(fleet), note="city")
    shown = {fleet.vehicles[i] for i in shown_vehicles(fleet, 0.7 * fleet.t[-1])}
    assert len(unwritten) == len(FIGURE_NAMES)
    for name, figure in zip(FIGURE_NAMES, unwritten, strict=True):
        assert figure.get_supxlabel().endswith(f"{NOTE}\ncity")
        panels = {"errors": 2 * MOST_SHOWN, "topology": MOST_SHOWN, "consistency": 3 * MOST_SHOWN}
        assert len(figure.axes) == panels.get(name, len(figure.axes))
        if name.startswith("trajectories"):
            drawn = {text for text in texts(figure) if text.startswith("$f")}
            assert len(drawn) == len(shown)


def test_vehicles_left_out_are_no_landmarks(fleet: Trajectory) -> None:
    """All lines of the plan belong to the vehicles shown and to the landmarks of the fleet."""
    few = fleet.of_vehicles(shown_vehicles(fleet, 0.7 * fleet.t[-1]))
    others = {*fleet.vehicles.tolist()} - {*few.vehicles.tolist()}
    drawn = draw_figure("trajectories_2d", fleet)
    alone = trajectory_figure_2d(few.without_targets(others))
    assert len(drawn.axes[0].lines) == len(alone.axes[0].lines)
    assert len(drawn.axes[0].lines) < len(trajectory_figure_2d(few).axes[0].lines)


def test_a_fleet_of_few_is_drawn_as_it_was(fleet: Trajectory) -> None:
    few = fleet.of_vehicles(range(MOST_SHOWN))
    figure = draw_figure("errors", few, note="city")
    assert len(figure.axes) == 2 * MOST_SHOWN and figure.get_supxlabel() == "city"


def test_the_printed_table_has_their_rows(fleet: Trajectory) -> None:
    quiet = {"not_observable_s": [[0.0, 1.0]], "carried_by_odometry_s": []}
    rows = [
        {**row, "guaranteed_rate_per_s": np.nan, "ended_at_s": np.nan, "observability": quiet}
        for row in summarise(fleet, 2.0)
    ]
    metrics = {"environment": "city", "vehicles": rows, "steady_from_s": 2.0, "observer": "robust"}
    lines = str(Results(metrics, fleet)).splitlines()
    names = [fleet.vehicles[i] for i in shown_vehicles(fleet, 2.0)]
    table = [line.split()[0] for line in lines if line.startswith("vehicle_")]
    assert table == [*names, *(f"{name}:" for name in names)]
    assert f"{NOTE}; all of them: metrics.json" in lines


def test_information_of_targets_never_seen_is_none(fleet: Trajectory) -> None:
    """Observability is that of each vehicle alone: of all, or of some, it is the same to the bit."""
    chosen = [3, 17]
    whole, some = analyse_observability(fleet).selected(chosen), analyse_observability(fleet.of_vehicles(chosen))
    for name in ("t", "local_eigenvalue", "condition_number", "vehicles"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(some, name))
