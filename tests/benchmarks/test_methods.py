"""The study of methods: every method trains and is judged, what is finished is kept, and what the figures say."""

from __future__ import annotations

import csv
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.methods import __main__ as command
from benchmarks.methods import report, study
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import scenario_path
from coopenv.policies import Policy
from coopenv.scenario import load_scenario

SMALL = """
decisions = 400
worlds = 3
block = 50
seeds = [1, 2]
noise = 0.1
references = ["route_follower"]
environments.lighthouse = "peek"
[methods]
ippo = { learner = "benchmarl", options = { algorithm = "ippo", worlds = 4, minibatch = 50, hidden = 8 } }
mappo = { learner = "benchmarl", options = { algorithm = "mappo", worlds = 4, minibatch = 50, hidden = 8 } }
communication.learner = "benchmarl"
communication.options = { algorithm = "ippo", communicates = true, worlds = 4, minibatch = 50, hidden = 8 }
ppo = { learner = "coopenv", options.ppo = { vehicles = 8, decisions = 25, minibatches = 2, hidden = [8] } }
recurrent.learner = "coopenv"
recurrent.options = { recurrent = true, ppo = { vehicles = 8, decisions = 25, minibatches = 2, hidden = [8] } }
clone = { learner = "offline", options = { algorithm = "clone", gradient_steps = 5, hidden = 8 } }
td3_bc = { learner = "offline", options = { algorithm = "td3_bc", gradient_steps = 5, hidden = 8 } }
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path


def results_of(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "results.csv").open(encoding="utf-8")))


@pytest.mark.slow
@pytest.mark.benchmarl
@pytest.mark.filterwarnings("ignore")
def test_every_method_trains_and_what_is_finished_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("benchmarl", "torch_geometric", "sb3_contrib", "minari"):
        pytest.importorskip(package, reason="needs the extra 'study'")
    place, page = written(tmp_path, SMALL), tmp_path / "page.md"
    arguments = [str(place), "--data", str(tmp_path / "data"), "--page", str(page)]
    assert command.main([*arguments, "--only", "1"]) == 0
    assert "8 of 16 runs are finished" in page.read_text()
    first = results_of(tmp_path)
    assert {row["seed"] for row in first} == {"1"} and len({row["return"] for row in first}) == 8
    assert command.main(arguments) == 0
    found, shown = results_of(tmp_path), capsys.readouterr()
    assert [row for row in found if row["seed"] == "1"] == first
    assert "8/8 lighthouse td3_bc 2" in shown.err
    assert page.read_text().count("\n| `") == 7 + 9
    assert ("apart from all others" in page.read_text()) != ("wins" in page.read_text())
    monkeypatch.setattr(command, "perform", lambda *given: pytest.fail("nothing is missing"))
    assert command.main(arguments) == 0


def test_only_a_part_of_the_study(tmp_path: Path) -> None:
    runs = study.runs(study.read_study(written(tmp_path, SMALL)))
    assert [run.key[:3] for run in command.chosen(runs, ["ippo", "clone", "2"])] == [
        ("lighthouse", "ippo", "2"),
        ("lighthouse", "clone", "2"),
    ]
    with pytest.raises(CoopenvError, match="has no 'IPPO'"):
        command.chosen(runs, ["IPPO"])


def test_a_changed_method_is_trained_anew(tmp_path: Path) -> None:
    def digests(text: str) -> dict[str, str]:
        return {
            run.method: run.digest for run in study.runs(study.read_study(written(tmp_path, text))) if run.seed == 1
        }

    before = digests(SMALL)
    changed = digests(SMALL.replace('algorithm = "mappo", worlds = 4', 'algorithm = "mappo", worlds = 5'))
    assert {name for name in before if before[name] != changed[name]} == {"mappo"}
    noisy = digests(SMALL.replace("noise = 0.1", "noise = 0.2"))
    assert {name for name in before if before[name] != noisy[name]} == {"clone", "td3_bc"}
    longer = digests(SMALL.replace("decisions = 400", "decisions = 500"))
    assert {name for name in before if before[name] == longer[name]} == {"route_follower"}


def test_a_changed_environment_is_learned_anew_and_its_new_description_is_not(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    text = scenario_path("lighthouse").read_text(encoding="utf-8")
    study_file = written(tmp_path, SMALL.replace("environments.lighthouse", f"environments.'{own}'"))

    def digest(changed: str) -> str:
        own.write_text(changed, encoding="utf-8")
        return study.runs(study.read_study(study_file))[0].digest

    before = digest(text)
    assert digest(text.replace("Two cars", "A pair of cars")) == before
    assert digest(text.replace("horizon = 40.0", "horizon = 41.0")) != before


def test_results_come_back_from_their_file(tmp_path: Path) -> None:
    runs = study.runs(study.read_study(written(tmp_path, SMALL)))
    figures = {name: 0.1 * i for i, name in enumerate(study.COLUMNS[4:])} | {"travel_time_s": float("nan")}
    study.write_results(tmp_path / "results.csv", {runs[0]: figures})
    found = study.read_results(tmp_path / "results.csv", runs)
    assert list(found) == runs[:1]
    np.testing.assert_allclose([*found[runs[0]].values()], [*figures.values()])
    assert study.read_results(tmp_path / "results.csv", runs[1:]) == {}
    (tmp_path / "results.csv").write_text("a,b\n1,2\n")
    with pytest.raises(CoopenvError, match="expected the columns"):
        study.read_results(tmp_path / "results.csv", runs)


def test_runs_with_fewer_losses_are_better_and_then_those_with_less_error() -> None:
    figures = [
        (0.2, 0.8, 0.1),
        (0.2, 0.3, 0.1),
        (0.81, 0.18, 0.106),
        (0.96, 0.0, 0.21),
        (1.0, 0.0, 0.9),
        (1.0, 0.0, 0.5),
    ]
    names = ("arrival_rate", "collision_rate", "e95_m")
    ranks = [study.rank({"e50_m": 0.1, **dict(zip(names, each, strict=True))}) for each in figures]
    assert ranks == sorted(ranks)


def test_interquartile_mean_of_five_runs() -> None:
    value, low, high = study.with_interval(np.array([9.0, 1.0, 3.0, 2.0, 100.0]))
    assert value == pytest.approx((2.0 + 3.0 + 9.0) / 3.0)
    assert 1.0 <= low < value < high <= 100.0


def test_probability_of_improvement_is_the_share_of_pairs() -> None:
    own, other = [np.array([1.0, 3.0]), np.array([0.0, 0.0])], [np.array([2.0, 2.0]), np.array([0.0, 1.0])]
    value, low, high = study.improvement(own, other)
    assert value == pytest.approx((2 / 4 + 1 / 4) / 2)
    assert low <= value <= high and study.improvement(other, own)[0] == pytest.approx(1.0 - value)
    apart = np.arange(5.0)
    assert study.improvement([apart + 5.0], [apart]) == (1.0, 1.0, 1.0)


def test_the_page_has_a_row_of_every_method(tmp_path: Path) -> None:
    asked = study.read_study(written(tmp_path, SMALL.replace("seeds = [1, 2]", "seeds = [1, 2, 3]")))
    arrived = {"ppo": 1.0, "clone": 0.5, "ippo": 0.25}
    figures = dict.fromkeys(study.COLUMNS[4:], 0.0)
    results = {
        run: {**figures, "arrival_rate": arrived.get(run.method, 0.0), "e95_m": 0.1 * run.seed}
        for run in study.runs(asked)
    }
    page = report.page(asked, results)
    assert "| `ippo` | 25 [25, 25] | 0 [0, 0] | 20 [10, 30] |  | 0.0 |" in page
    assert "| `clone` | 50 [50, 50] | 0 [0, 0] | 20 [10, 30] | 1.00 [1.00, 1.00] | 0.0 |" in page
    assert "| `mappo` | 0 [0, 0] | 0 [0, 0] | 20 [10, 30] | 0.00 [0.00, 0.00] | 0.0 |" in page
    assert "`ppo` wins" in page
    del results[next(iter(results))]
    assert "23 of 24 runs are finished" in report.page(asked, results)


def test_the_page_in_the_documents_is_that_of_the_results() -> None:
    asked, rows = study.read_study(command.HERE / "study.toml"), results_of(command.HERE)
    results = {
        study.Run(row["environment"], row["method"], int(row["seed"]), row["digest"]): {
            name: float(row[name]) for name in study.COLUMNS[4:]
        }
        for row in rows
    }
    page = (command.HERE.parents[1] / "docs" / "environments" / "methods.md").read_text(encoding="utf-8")
    assert page == report.page(asked, results)


@pytest.mark.parametrize(("shift", "words"), [(10.0, "`b` wins"), (0.5, "No method is apart")])
def test_the_verdict_names_a_winner_only_where_intervals_are_apart(shift: float, words: str) -> None:
    runs = np.arange(5.0)
    assert report.verdict({"a": [runs], "b": [runs + shift]}).startswith(words)


@pytest.mark.train
def test_recurrent_ppo_learns_from_rows_under_way_alone() -> None:
    pytest.importorskip("sb3_contrib", reason="needs the extra 'study'")
    pytest.importorskip("benchmarl", reason="needs the extra 'study'")
    import torch
    from gymnasium.spaces import Box
    from sb3_contrib.common.recurrent.type_aliases import RNNStates

    from benchmarks.methods.online import ActingSequences

    steps, rows, random = 6, 4, np.random.default_rng(0)
    acted = random.random((steps, rows)) < 0.6
    batch, space, nothing = SimpleNamespace(acted=acted[0]), Box(-1.0, 1.0, (1,)), torch.zeros(1, rows, 2)
    buffer = ActingSequences(steps, space, space, (steps, 1, rows, 2), "cpu", n_envs=rows, rows=batch)
    for step in range(steps):
        batch.acted = acted[step]
        seen = np.where(acted[step], 1.0, -1.0)[:, None]
        zero, state = torch.zeros(rows), RNNStates((nothing, nothing), (nothing, nothing))
        starts = np.full(rows, step == 0) | (random.random(rows) < 0.2)
        buffer.add(seen, seen, np.zeros(rows), starts, zero, zero, lstm_states=state)
    for _ in range(2):
        samples = [*buffer.get(8)]
        assert sum(int(each.mask.sum()) for each in samples) == acted.sum()
        assert all((each.observations[each.mask > 0.5] == 1.0).all() for each in samples)


@pytest.mark.slow
@pytest.mark.benchmarl
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("communicates", [False, True])
def test_only_with_communication_a_vehicle_acts_on_what_others_observe(communicates: bool) -> None:
    for package in ("benchmarl", "torch_geometric", "sb3_contrib"):
        pytest.importorskip(package, reason="needs the extra 'study'")
    from benchmarks.methods.online import benchmarl

    options = {"algorithm": "ippo", "communicates": communicates, "worlds": 2, "minibatch": 50, "hidden": 8}
    learned, ended = benchmarl("lighthouse", 100, 1, options), np.zeros((1, 2), dtype=np.int32)

    def driver(team: str) -> Policy:
        backend = SimpleNamespace(scenario=load_scenario("lighthouse", {"reward.team": team}))
        return learned(SimpleNamespace(view=lambda name: ended, backend=backend))  # type: ignore[arg-type]

    seen = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 59)).astype(np.float32)
    changed = seen.copy()
    changed[1] = 0.5
    before, after = driver("own")(seen), driver("own")(changed)
    assert not np.allclose(before[1], after[1])
    assert np.allclose(before[0], after[0]) != communicates
    ended[0, 1] = 1  # what it observes then counts until the episode is over for the team
    np.testing.assert_array_equal(driver("mean")(changed), after)
    np.testing.assert_array_equal(driver("own")(seen), driver("own")(changed))
