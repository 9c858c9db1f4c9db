"""A table of a rule, planners and a team: paired differences, lost vehicles at 1 m, and fields that read 0."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import teams
from coopenv import load_scenario
from coopenv.api.engine import Engine
from coopenv.api.terms.layout import observation_layout
from coopenv.evaluation import drive, held_out_seeds


def test_a_driver_that_stands_still_is_lost_for_the_rest_of_its_way() -> None:
    scenario = load_scenario("pilot", {"horizon": 4.0})
    still = drive(Engine(scenario, 2), lambda rows: np.tile([-1.0, 0.0], (len(rows), 1)), held_out_seeds(9, 2))
    own = np.minimum(still.position_error, 1.0)[still.time >= 3.0].mean(axis=(0, 2))
    assert (teams.mean_errors(still) > own).all() and (teams.mean_errors(still) <= 1.0).all()


def test_blanked_fields_read_zero_and_the_others_are_as_observed() -> None:
    scenario, seen = load_scenario("pilot"), list[np.ndarray]()
    layout = observation_layout(scenario)

    def policy(rows: np.ndarray) -> np.ndarray:
        seen.append(rows)
        return np.zeros((len(rows), 2))

    given = np.ones((3, layout.size), dtype=np.float32)
    teams.Blanked(scenario, policy, ("seen_age", "no_such_field"))(given)
    field = layout["seen_age"]
    assert not seen[0][:, field.start : field.stop].any() and seen[0].sum() == given.sum() - 3 * 2 and given.all()


def test_the_page_has_the_table_and_its_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(teams, "DRIVERS", ("route_follower",))
    assert teams.main(["pilot", "--worlds", "2", "--block", "9", "--page", str(tmp_path)]) == 0
    text = json.loads((tmp_path / "pilot.json").read_text())["text"]
    assert text in capsys.readouterr().out and "benchmarks.teams pilot --worlds 2 --block 9" in text
    rows = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("|")][2:]
    assert rows == ["pilot_rule", "route_follower", "pilot_team", *(f"pilot_team, {how}" for how in teams.ABLATIONS)]


def test_an_environment_without_a_team_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert teams.main(["facade", "--worlds", "2"]) == 2
    assert capsys.readouterr().err.startswith("error: unknown agent 'facade_rule'")
