"""Episodes of a batch are those of single worlds; figures and the bootstrap over worlds are those made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import coopenv
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.estimation import Outcome
from coopenv.evaluation import METRICS, Episodes, compare_paired, drive, held_out_seeds, ranking_key, score
from coopenv.evaluation.episodes import BLOCK_WORLDS, BLOCKS
from coopenv.evaluation.metrics import Quantile, Ratio, interval, resamples, scored_errors
from coopenv.policies import load_agent
from coopenv.policies.base import zero_policy
from coopenv.runs import rollout
from coopenv.scenario.terms import LOST
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.trips import trips

SCENARIO = coopenv.load_scenario(FOUR_WAY, {"horizon": 16.0})


@pytest.fixture(scope="module")
def episodes() -> Episodes:
    return drive(Engine(SCENARIO, 6), load_agent("route_follower", SCENARIO), held_out_seeds(2, 6))


def test_a_world_of_the_batch_is_that_world_alone(episodes: Episodes) -> None:
    seed = held_out_seeds(2, 6)[4]
    run = rollout(SCENARIO, seed=seed, dtype="float32", policy="route_follower")
    every = SCENARIO.ticks_per_decision
    K = min(len(episodes.under_way), (len(run.t) - 1) // every)
    np.testing.assert_allclose(
        episodes.position_error[:K, 4], run.position_error[every::every][:K], rtol=1e-3, atol=1e-5
    )
    np.testing.assert_allclose(episodes.position[: K + 1, 4], run.position[::every, :, :2][: K + 1], atol=1e-4)
    np.testing.assert_array_equal(episodes.targets_in_view[:K, 4], run.visible[every::every].sum(axis=-1)[:K])
    heading = np.arctan2(run.rotation[..., 1, 0], run.rotation[..., 0, 0])[every::every]
    np.testing.assert_allclose(np.exp(1j * episodes.heading[:K, 4]), np.exp(1j * heading[:K]), atol=1e-4)


def test_figures_against_their_definitions(episodes: Episodes) -> None:
    found = {result.metric: result for result in score(episodes)}
    assert list(found) == list(METRICS)
    counted = episodes.under_way & (episodes.time >= 3.0)[:, None, None]
    errors = episodes.position_error[counted]
    assert found["e50_m"].mean == pytest.approx(np.median(errors))
    assert found["e95_m"].mean == pytest.approx(np.quantile(errors, 0.95))
    assert found["rmse_m"].mean == pytest.approx(np.sqrt(np.mean(errors.astype(float) ** 2)))
    whole = episodes.orientation_error[episodes.under_way]
    assert found["orientation_e50_episode_deg"].mean == pytest.approx(np.median(whole))
    assert found["few_targets_share"].mean == pytest.approx((episodes.targets_in_view[counted] < 3).mean())
    assert found["return"].mean == pytest.approx(episodes.reward.sum() / 24, rel=1e-4)
    arrived = episodes.outcome == Outcome.ARRIVED
    assert found["arrival_rate"].mean == pytest.approx(arrived.mean())
    assert found["travel_time_s"].mean == pytest.approx(np.nanmean(episodes.travel_time))
    for result in found.values():
        assert result.ci_low <= result.mean <= result.ci_high and 0 < result.n <= 6


def test_a_share_that_is_the_same_everywhere_has_an_interval_all_the_same(episodes: Episodes) -> None:
    never = replace(episodes, arrivals=np.zeros_like(episodes.arrivals))
    found = {result.metric: result for result in score(never)}
    arrived, time = found["arrival_rate"], found["travel_time_s"]
    assert (arrived.mean, arrived.ci_low) == (0.0, 0.0) and 0.2 < arrived.ci_high < 0.5  # Wilson, 0 of 6
    assert np.isnan([time.mean, time.ci_low, time.ci_high]).all() and time.n == 0


def test_paired_differences(episodes: Episodes) -> None:
    worse = replace(episodes, position_error=1.25 * episodes.position_error)
    differences = {difference.metric: difference for difference in compare_paired(worse, episodes)}
    e95 = differences["e95_m"]
    for value in (e95.relative, e95.relative_ci_low, e95.relative_ci_high):
        assert value == pytest.approx(0.25, abs=1e-3)  # of the pair, although the worlds differ
    same = differences["orientation_e95_deg"]
    assert (same.difference, same.ci_low, same.ci_high) == (0.0, 0.0, 0.0)


def test_travel_times_are_compared_over_vehicles_that_arrive_with_both(episodes: Episodes) -> None:
    slowest = episodes.travel_time == np.nanmax(episodes.travel_time)
    fewer = replace(episodes, arrivals=np.where(slowest, 0, episodes.arrivals))
    difference = next(d for d in compare_paired(fewer, episodes) if d.metric == "travel_time_s")
    assert difference.difference == 0.0
    assert np.nanmean(fewer.travel_time) < np.nanmean(episodes.travel_time)


def test_an_error_that_is_no_number_counts_as_a_huge_one(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = Engine(SCENARIO, 2)
    view = engine.view
    monkeypatch.setattr(engine, "view", lambda name: view(name) * np.nan if name == "position_error" else view(name))
    found = drive(engine, zero_policy(), [1, 2])
    assert (found.position_error > 1e8).all() and (found.orientation_error < 1e3).all()


def test_no_two_blocks_share_a_seed_whatever_the_number_of_worlds() -> None:
    few, many = [{*held_out_seeds(block, 3)} for block in range(1, 90)], {*held_out_seeds(0, 256)}
    assert many == {*range(2**31, 2**31 + 256)}  # those of the figures on cards
    assert all(not many & block for block in few) and len(set().union(*few)) == 3 * 89
    last = held_out_seeds(BLOCKS - 1, BLOCK_WORLDS)
    assert min(last) > max(held_out_seeds(BLOCKS - 2, BLOCK_WORLDS)) and max(last) in coopenv.EVALUATION_SEEDS
    assert max(last) < coopenv.evaluation_seed(2**30)  # from here on, seeds judge agents while they learn
    for block, worlds in ((BLOCKS, 1), (0, BLOCK_WORLDS + 1)):
        with pytest.raises(CoopenvError, match="seed_block must be below 16384 and worlds at most 65536"):
            held_out_seeds(block, worlds)


def test_vehicles_that_are_not_there_do_not_count(episodes: Episodes) -> None:
    outcome, reward = episodes.outcome.copy(), episodes.reward.copy()
    outcome[0, :2], reward[:, 0, :2] = -1, 1e6
    found = {result.metric: result.mean for result in score(replace(episodes, outcome=outcome, reward=reward))}
    there = np.ones((6, 4), dtype=bool)
    there[0, :2] = False
    assert found["return"] == pytest.approx(episodes.reward.sum(axis=0)[there].mean(), rel=1e-4)
    assert found["collision_rate"] == 0.0


def test_vehicles_that_go_on_have_arrived_once_they_have(episodes: Episodes) -> None:
    on = episodes.arrivals.copy()
    on[-1] += 1  # a second arrival does not change when the first was
    there = on[-2] > 0
    np.testing.assert_array_equal(replace(episodes, arrivals=on).travel_time[there], episodes.travel_time[there])


def test_looking_counts_from_the_nearest_piece_of_the_route() -> None:
    route = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [4.0, 4.0]])[None, None]
    position = np.array([[0.0, 0.0], [1.0, 0.3], [4.2, 2.0], [3.9, 6.0]])[:, None, None]
    heading = np.array([0.3, np.pi / 2 - 0.4, -np.pi])[:, None, None]
    none = np.zeros((3, 1, 1))
    found = Episodes(("a",), 0.1, *(none,) * 5, position, heading, none, route, none, none[0], none, none[0] > 0, 3)
    np.testing.assert_allclose(found.looking[:, 0, 0], [0.3, -0.4, np.pi / 2], atol=1e-12)
    panned = replace(found, pan=np.array([0.2, -0.3, np.pi])[:, None, None])  # the camera, not the car, says where
    np.testing.assert_allclose(panned.looking[:, 0, 0], [0.5, -0.7, -np.pi / 2], atol=1e-12)


WORLDS = 12


def sample(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return values and their worlds: as many as they like, around a level of each world's own."""
    rng = np.random.default_rng(seed)
    world = rng.integers(0, WORLDS, 9000)
    return np.exp(rng.normal(size=9000) + 0.5 * rng.normal(size=WORLDS)[world]), world


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_quantiles_of_resampled_worlds(share: float) -> None:
    values, world = sample()
    counts = resamples(WORLDS, 3, count=50)
    by_hand = [np.quantile(np.repeat(values, row[world].astype(int)), share) for row in counts]
    found = Quantile(values, world, WORLDS, share)
    assert found.value == np.quantile(values, share)
    np.testing.assert_allclose(found.resampled(counts), by_hand, rtol=0.02)


def test_means_and_root_mean_squares_of_resampled_worlds() -> None:
    values, world = sample()
    counts = resamples(WORLDS, 3, count=50)
    total, squares, number = (np.bincount(world, w, WORLDS) for w in (values, values**2, np.ones(9000)))
    repeated = [np.repeat(values, row[world].astype(int)) for row in counts]
    np.testing.assert_allclose(Ratio(total, number).resampled(counts), [v.mean() for v in repeated])
    rms = Ratio(squares, number, root=True)
    np.testing.assert_allclose(rms.resampled(counts), [np.sqrt((v**2).mean()) for v in repeated])
    assert rms.value == pytest.approx(np.sqrt((values**2).mean()))


def test_values_that_are_all_the_same_and_none_at_all() -> None:
    counts = resamples(3, 0, count=20)
    same = Quantile(np.full(9, 2.5), np.repeat(np.arange(3), 3), 3, 0.95)
    assert same.value == 2.5 and (same.resampled(counts) == 2.5).all() and same.worlds == 3
    none = Quantile(np.empty(0), np.empty(0, dtype=int), 3, 0.5)
    assert np.isnan(none.value) and np.isnan(none.resampled(counts)).all() and none.worlds == 0
    assert np.isnan(interval(none.resampled(counts))).all()
    one = Quantile(np.array([1.0]), np.array([1]), 3, 0.5)
    assert one.worlds == 1
    np.testing.assert_array_equal(np.isnan(one.resampled(counts)), counts[:, 1] == 0)


def test_resamples_are_of_as_many_worlds_and_repeatable() -> None:
    counts = resamples(WORLDS, 5, count=400)
    assert (counts.sum(axis=1) == WORLDS).all() and counts.mean(axis=0) == pytest.approx(np.ones(WORLDS), abs=0.2)
    np.testing.assert_array_equal(counts, resamples(WORLDS, 5, count=400))
    assert (counts != resamples(WORLDS, 6, count=400)).any()


def test_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    """Means of 40 worlds with levels of their own: 95 % intervals, 300 experiments."""
    rng, held = np.random.default_rng(1), 0
    counts = resamples(40, 0, count=400)
    for _ in range(300):
        level = rng.normal(size=40)
        values = level + 0.1 * rng.normal(size=(25, 40))
        low, high = interval(Ratio(values.sum(axis=0), np.full(40, 25.0)).resampled(counts))
        held += low <= 0.0 <= high
    assert 0.89 <= held / 300 <= 0.99


def figures(episodes: Episodes) -> dict[str, float]:
    return {name: metric.of(episodes).value for name, metric in METRICS.items()}


def test_a_driver_that_crashes_in_18_percent_ranks_behind_one_that_never_does() -> None:
    """Both as measured in open_square: 81 % arrive with an e95 of 11 cm, against 96 % with 21 cm."""
    crashing = trips([0.106] * 100, np.arange(100) >= 18, np.where(np.arange(100) < 18, 16, 40))
    careful = trips([0.21] * 100, np.arange(100) >= 4, np.where(np.arange(100) < 4, 80, 40), speed=0.45)
    bad, good = figures(crashing), figures(careful)
    assert bad["e95_m"] == LOST and good["e95_m"] == pytest.approx(0.21)
    assert ranking_key(good) < ranking_key(bad)


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_a_crash_in_place_of_an_arrival_never_improves_the_score(data: st.DataObject) -> None:
    W = data.draw(st.integers(1, 6))
    errors = data.draw(st.lists(st.floats(0.0, 3.0), min_size=W, max_size=W))
    arrived = np.array([True, *data.draw(st.lists(st.booleans(), min_size=W - 1, max_size=W - 1))])
    ended = np.where(arrived, 40, data.draw(st.lists(st.integers(1, 39), min_size=W, max_size=W)))
    before = figures(trips(errors, arrived, ended))
    crash = np.where(np.arange(W) == 0, data.draw(st.integers(1, 40)), ended)
    after = figures(trips(errors, arrived & (np.arange(W) > 0), crash))
    for name in ("e50_m", "e95_m", "mean_m", "e50_episode_m", "e95_episode_m", "mean_episode_m"):
        assert np.isnan(before[name]) or after[name] >= before[name] - 1e-12, name
    assert ranking_key(before) <= ranking_key(after)


def test_an_early_crash_weighs_more_than_a_late_one() -> None:
    """Each on 20 m of which 1 m is driven in a decision, and errors count from the sixth decision on."""
    early, late = (trips([0.1] * 20, np.arange(20) > 0, np.where(np.arange(20) > 0, 20, e), speed=2.0) for e in (2, 19))
    assert (early.lost_for[0, 0], late.lost_for[0, 0]) == (18, 1) and (early.lost_for[1:] == 0).all()
    for driven, lost in ((early, 15), (late, 1)):  # the first three of those 18 are before 3 s
        values, worlds = scored_errors(driven)
        assert len(values) == 20 * 15 and (values == LOST).sum() == lost and (worlds[values == LOST] == 0).all()
        assert figures(driven)["mean_m"] == pytest.approx(0.1 + lost * (LOST - 0.1) / 300)


def test_a_vehicle_that_has_not_arrived_at_the_horizon_is_lost_for_the_rest_of_its_way() -> None:
    slow = trips([0.1], np.array([False]), np.array([80]), speed=0.375)  # 15 of 20 m
    assert slow.lost_for[0, 0] == 27 and (scored_errors(slow, start=0.0)[0] == LOST).sum() == 27
    standing = trips([0.1], np.array([False]), np.array([80]), speed=0.0)
    assert standing.lost_for[0, 0] == 80  # at most another episode
    aimless = replace(standing, goal=np.zeros((1, 1), dtype=bool))
    assert aimless.lost_for[0, 0] == 0 and figures(aimless)["e95_m"] == pytest.approx(0.1)
    collided = trips([0.1], np.array([False]), np.array([30]))
    nowhere = np.full_like(collided.route, np.nan)
    assert replace(collided, goal=np.zeros((1, 1), dtype=bool), route=nowhere).lost_for[0, 0] == 50  # of the episode
    assert replace(collided, goal=np.zeros((1, 1), dtype=bool)).lost_for[0, 0] == 50  # its route ends nothing
    once = replace(collided, arrivals=np.ones_like(collided.arrivals))
    assert once.lost_for[0, 0] == 50  # on another way, after an arrival
    assert replace(collided, outcome=-collided.outcome).lost_for[0, 0] == 0  # never there


def test_the_interval_of_lost_vehicles_is_theirs() -> None:
    values, world = np.append(np.linspace(0.0, 0.2, 900), np.full(100, LOST)), np.tile(np.arange(10), 100)
    found = Quantile(values, world, 10, 0.95)
    assert found.value == LOST and interval(found.resampled(resamples(10, 0))) == (LOST, LOST)


def test_losses_are_ranked_before_errors_and_errors_within_a_step() -> None:
    def driver(arrived: float, collided: float, e95: float, e50: float = 0.1) -> dict[str, float]:
        return {"arrival_rate": arrived, "collision_rate": collided, "e95_m": e95, "e50_m": e50}

    ordered = [
        driver(1.0, 0.0, 0.1),
        driver(0.99, 0.0, 0.2),
        driver(0.96, 0.0, 0.21),
        driver(0.97, 0.03, 0.05),  # of as many that do not arrive, the ones that crash come last
        driver(0.81, 0.18, 0.106),
        driver(0.0, 1.0, 1.0, 0.8),
        driver(0.0, 1.0, 1.0, 0.9),
    ]
    assert sorted(reversed(ordered), key=ranking_key) == ordered
    assert ranking_key(driver(1.0, 0.0, float("nan"))) > ranking_key(ordered[0])
