"""Recording a run, and episodes of single vehicles as a data set: the same world as the environment's, tick by tick."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.api.registration import registered_spec
from coopenv.base.errors import CoopenvError, DeviceError
from coopenv.base.format import json_text
from coopenv.cli.app import main
from coopenv.estimation import Sight
from coopenv.estimation.metrics import CONVERGED
from coopenv.estimation.observability import analyse_observability
from coopenv.estimation.trajectory import Trajectory
from coopenv.policies import load_agent
from coopenv.report.table import Table
from coopenv.runs import Rollout, rollout
from coopenv.runs.command import noise_note
from coopenv.runs.console import COLUMNS, gaps, legend, rates, remarks
from coopenv.runs.exports import drive_vehicles
from coopenv.runs.rollouts import Ending, outcome_line, run_metrics, theory_rates, vehicle_metrics
from coopenv.sources.mcap import read_recording
from tests.helpers.commands import printed, refused
from tests.helpers.env_suite import SHIPPED
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.synthetic import make_trajectory

CASES: list[tuple[str, dict[str, Any]]] = [
    *((name, {}) for name in {(made.backend, made.observer.name): name for name, made in SHIPPED.items()}.values()),
    *((FOUR_WAY, {"dynamics.latency": ticks / 60.0}) for ticks in (0, 1, 3, 6)),
    (FOUR_WAY, {"action.longitudinal": "acceleration", "rates.decision": 5.0}),
    ("busy_intersection", {"v2x.delay": 7, "v2x.period": 4, "v2x.loss": 0.3, "rates.observer": 25.0}),
]


@pytest.mark.parametrize(("name", "overrides"), CASES)
def test_recorded_ticks_equal_the_environment_stepped_by_decisions(name: str, overrides: dict[str, Any]) -> None:
    overrides = {**overrides, "horizon": 7.35}  # not a whole number of decisions
    scenario = coopenv.load_scenario(name, overrides)
    actions = np.random.default_rng(5).uniform(-1.0, 1.0, (200, len(scenario.vehicles), 2))
    given = iter(actions)
    run = rollout(scenario, seed=7, policy=lambda observations: next(given))
    env = coopenv.parallel_env(name, dtype="float64", overrides=overrides)
    env.reset(seed=7)
    tick, names = 0, scenario.vehicle_names
    for action in actions:
        if not env.agents:
            break
        *_, infos = env.step({agent: action[names.index(agent)] for agent in env.agents})
        tick = min(tick + scenario.ticks_per_decision, scenario.horizon_ticks)
        for agent, info in infos.items():
            i = names.index(agent)
            assert np.array_equal(info["truth"]["position"], run.position[tick, i])
            assert np.array_equal(info["truth"]["rotation"], run.rotation[tick, i])
            assert np.array_equal(info["estimate"]["position"], run.position_estimate[tick, i])
            assert np.array_equal(info["estimate"]["rotation"], run.rotation_estimate[tick, i])
            assert np.array_equal(info["estimate"]["covariance"], run.covariance[tick, i])
            assert info["position_error"] == run.position_error[tick, i]
            assert info["nees"] == run.nees[tick, i]
            assert info["visible"] == tuple(run.targets[run.visible[tick, i]])
    assert tick == len(run.t) - 1


def test_the_record_has_the_documented_arrays() -> None:
    scenario = coopenv.load_scenario("crossing_path", {"horizon": 1.0})
    run = rollout(scenario, seed=1)
    K, N, T = 61, 1, 6
    assert run.t == pytest.approx(np.arange(K) / 60.0)
    assert run.position.shape == run.velocity.shape == run.position_estimate.shape == (K, N, 3)
    assert run.rotation.shape == run.rotation_estimate.shape == (K, N, 3, 3)
    assert run.covariance.shape == (K, N, 6, 6)
    assert run.position_error.shape == run.orientation_error.shape == run.nees.shape == (K, N)
    assert run.sight.shape == run.visible.shape == (K, N, T)
    assert run.target_position.shape == (K, T, 3)
    assert run.targets.tolist() == scenario.target_names
    assert run.target_moving.tolist() == [False, False, False, False, True, True]
    assert np.array_equal(run.target_position[:, 5], run.position[:, 0])
    assert run.target_position[0, 0].tolist() == list(scenario.landmarks[0].position)
    assert np.array_equal(run.visible, run.sight == Sight.VISIBLE)
    error = np.linalg.norm(run.position - run.position_estimate, axis=-1)
    assert run.position_error == pytest.approx(error, abs=1e-12)


def test_steps_are_decisions_and_end_at_the_horizon() -> None:
    scenario = coopenv.load_scenario("busy_intersection", {"horizon": 2.0})
    assert len(rollout(scenario, steps=3).t) == 1 + 3 * 6
    assert len(rollout(scenario, steps=1000).t) == 1 + 120


def test_policies_are_seeded_and_reach_the_vehicles() -> None:
    scenario = coopenv.load_scenario(FOUR_WAY)
    first, again = (rollout(scenario, seed=4, steps=20, policy="random") for _ in range(2))
    assert np.array_equal(first.position, again.position)
    assert not np.array_equal(first.position, rollout(scenario, seed=5, steps=20, policy="random").position)
    straight = rollout(scenario, seed=4, steps=20)
    assert not np.array_equal(first.position, straight.position)
    assert np.array_equal(first.position[0], straight.position[0])
    clipped = rollout(scenario, seed=4, steps=20, policy=lambda o: np.full((4, 2), 9.0))
    full = rollout(scenario, seed=4, steps=20, policy=lambda o: np.ones((4, 2)))
    assert np.array_equal(clipped.position, full.position)


def test_the_run_ends_with_the_last_vehicle() -> None:
    scenario = coopenv.load_scenario(FOUR_WAY, {"vehicles.*.goal.radius": 30.0})
    recording = Rollout(scenario)
    ticks = list(recording.play())
    assert ticks == list(range(scenario.ticks_per_decision + 1))
    assert {ending.outcome for ending in recording.endings()} == {"arrived"}
    assert outcome_line(recording) == "all vehicles had ended by 0.01667 s (4 arrived)"


def test_on_tick_sees_every_tick() -> None:
    seen: list[tuple[int, int]] = []
    scenario = coopenv.load_scenario("busy_intersection")
    rollout(scenario, steps=2, on_tick=lambda engine, tick: seen.append((tick, int(engine.view("tick")[0]))))
    assert seen == [(k, k) for k in range(13)]


def test_float32_is_recorded_in_float32() -> None:
    assert rollout(coopenv.load_scenario("busy_intersection"), steps=1, dtype="float32").covariance.dtype == np.float32


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"steps": 0}, CoopenvError, "steps"),
        ({"dtype": "float16"}, DeviceError, "float16"),
        ({"device": "tpu"}, DeviceError, "tpu"),
        ({"policy": "zeros"}, CoopenvError, "did you mean 'zero'"),
        ({"policy": lambda observations: np.zeros(2)}, CoopenvError, "shape"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        rollout(coopenv.load_scenario("busy_intersection"), **arguments)


def test_an_interrupted_run_keeps_what_was_recorded(tmp_path: Path) -> None:
    recording = Rollout(coopenv.load_scenario("busy_intersection"), seed=2)
    for tick in recording.play():
        if tick == 100:
            break
    trajectory = recording.trajectory()
    assert len(trajectory.t) == 101
    assert outcome_line(recording) == "ended before its time, at 1.66667 s"
    trajectory.save(tmp_path / "run.npz")
    assert np.array_equal(Trajectory.load(tmp_path / "run.npz").position, trajectory.position)


def played(recording: Rollout) -> Rollout:
    for _ in recording.play():
        pass
    return recording


def test_metrics_are_strict_json_with_figures_of_every_vehicle() -> None:
    recording = played(Rollout(coopenv.load_scenario("busy_intersection"), seed=3, steps=60))
    trajectory = recording.trajectory()
    vehicles = vehicle_metrics(trajectory, analyse_observability(trajectory), recording.endings(), 35.0)
    metrics = run_metrics("busy_intersection", {"a.b": [1]}, recording, vehicles, 35.0)
    text = json_text(metrics)
    assert "NaN" not in text
    read = json.loads(text)
    assert (read["seed"], read["overrides"], read["simulated_time_s"]) == (3, {"a.b": [1]}, 6.0)
    assert read["versions"]["coopenv"] == coopenv.__version__ and read["real_time_factor"] > 1.0
    assert [vehicle["vehicle"] for vehicle in read["vehicles"]] == [f"vehicle_{i}" for i in range(1, 6)]
    first, last = read["vehicles"][0], read["vehicles"][4]
    assert first["steady_position_rmse_m"] is None  # the run ends before
    assert first["observability"]["share_observable"] == 1.0
    assert 0.0 < last["observability"]["share_observable"] < 1.0
    assert last["observability"]["not_observable_s"][0][0] == 0.0
    assert first["settle_time_s"] <= first["convergence_time_s"]


def test_a_record_shorter_than_any_window_still_has_metrics() -> None:
    recording = Rollout(coopenv.load_scenario("busy_intersection"))
    next(recording.play())
    trajectory = recording.trajectory()
    vehicles = vehicle_metrics(trajectory, analyse_observability(trajectory), recording.endings(), 0.0)
    assert math.isnan(vehicles[0]["observability"]["share_observable"])


def vehicles_of(name: str, policy: str = "zero", **overrides: Any) -> tuple[Rollout, list[dict[str, Any]]]:
    recording = played(Rollout(coopenv.load_scenario(name, overrides), seed=1, policy=policy))
    run = recording.trajectory()
    return recording, vehicle_metrics(run, analyse_observability(run), recording.endings(), 5.0)


def test_figures_of_a_vehicle_end_with_it() -> None:
    recording, vehicles = vehicles_of(FOUR_WAY, "route_follower")
    run, endings = recording.trajectory(), recording.endings()
    assert min(ending.time for ending in endings) < run.t[-1] - 1.0
    for i, (vehicle, ending) in enumerate(zip(vehicles, endings, strict=True)):
        part = run.t <= ending.time + 1e-6
        assert vehicle["ended_at_s"] == ending.time
        assert vehicle["mean_targets_in_view"] == pytest.approx(run.visible[part, i].sum(axis=-1).mean())
        assert vehicle["final_position_error_m"] == run.position_error[part, i][-1]
        steady = part & (run.t > 5.0)
        assert vehicle["mean_nees"] == pytest.approx(run.nees[steady, i].mean())
        rmse = np.sqrt(np.mean(run.position_error[steady, i] ** 2))
        assert vehicle["steady_position_rmse_m"] == pytest.approx(rmse)
        gaps = vehicle["observability"]["not_observable_s"]
        assert all(end <= ending.time + 1e-6 for _, end in gaps)
    assert "arrived at" in next(remarks(vehicles))


def test_the_table_has_a_row_per_vehicle_and_a_legend() -> None:
    _, vehicles = vehicles_of("crossing_path", horizon=20.0)
    assert math.isnan(vehicles[0]["ended_at_s"])
    assert vehicles[0]["rate_remark"] == "error fell below half within 1 tick, no rate to fit"
    assert list(remarks(vehicles)) == []
    table = Table.of(COLUMNS, vehicles, folds=True)
    assert len(table) == len(vehicles)
    assert [heading.split()[0] for heading in table.headings][3:5] == ["settles", "converges"]
    assert not any("-" in heading for heading in table.headings)
    assert [*legend(5.0, 20.0, 6)] == [
        "Settles: stays below 0.5 m and 5 deg. Converges: stays below 0.1 m and 1 deg.",
        "RMSE and NEES: steady state, after 5 s. NEES of a consistent estimate: 6.",
    ]


def test_what_a_recording_lacks_is_reported() -> None:
    metrics = {"ticks": 99, "missing_ticks": {"vehicle_1": 1, "vehicle_2": 20}}
    assert [*gaps(metrics, 60, 2.5)] == [
        "Judged at 60 of 100 ticks, up to 2.5 s: at the others a true pose is not known.",
        "vehicle_2: no odometry at 20 of 100 ticks; its last was kept, and no bearing was used",
    ]
    assert [*gaps(metrics | {"missing_ticks": {}}, 100, 9.9)] == []


def test_what_odometry_carries_is_distinguished() -> None:
    """Bearings end at 20 s, when every estimate is within centimetres: odometry keeps it there."""
    run = make_trajectory()
    dark = replace(run, visible=run.visible & (run.t < 20.0)[:, None, None])
    endings = [Ending("under way", 50.0)] * 5
    rows = vehicle_metrics(dark, analyse_observability(dark), endings, 35.0)
    for vehicle, row in zip(range(5), rows, strict=True):
        found = row["observability"]
        known = CONVERGED.contains(run.position_error[:, vehicle], run.orientation_error[:, vehicle])
        (start, end) = found["carried_by_odometry_s"][-1]
        assert end == 50.0 and known[run.t > start].all()
        for before, after in found["not_observable_s"]:
            assert not known[(run.t >= before) & (run.t <= after + 1e-9)].all()
    assert any("carried by odometry (within 0.1 m and 1 deg) at " in line for line in remarks(rows))


def test_rates_of_the_theory_are_those_of_the_papers_observer() -> None:
    _, vehicles = vehicles_of("overtaking", **{"horizon": 12.0, "observer.name": "robust"})
    assert all(math.isnan(vehicle["guaranteed_rate_per_s"]) for vehicle in vehicles) and list(rates(vehicles)) == []
    recording = played(Rollout(coopenv.load_scenario("busy_intersection", {"noise.enabled": False, "horizon": 12.0})))
    run = recording.trajectory()
    theory = theory_rates(recording, run)
    assert theory is not None and theory.guaranteed.shape == (721, 5)
    rows = vehicle_metrics(run, analyse_observability(run), recording.endings(), 8.0, theory)
    assert 0.5 < rows[0]["guaranteed_rate_per_s"] < min(rows[0]["slowest_rate_per_s"], rows[0]["rate_per_s"])
    assert 0.0 < rows[4]["guaranteed_rate_per_s"] < 0.05 and math.isnan(rows[4]["slowest_rate_per_s"])  # still off
    for i, row in enumerate(rows):
        assert row["guaranteed_rate_per_s"] == theory.guaranteed[:, i].min()
        assert row["frozen_rate_per_s"] <= row["frozen_rate_window_per_s"]
    text = printed(*rates(rows))
    assert "vehicle_5" in text and "…" not in text


OVERRIDES: dict[str, Any] = {"horizon": 8.0, "termination.after_arrival": "park"}


def follow(observations: np.ndarray) -> np.ndarray:
    """Full speed, and a turn that hits walls sooner or later."""
    return np.column_stack([np.ones(len(observations)), 0.3 * np.sign(observations[:, 0])])


def test_episodes_are_those_of_the_environment() -> None:
    scenario = coopenv.load_scenario(FOUR_WAY, OVERRIDES)
    episodes = drive_vehicles(scenario, follow, 5, 2)
    assert [(e.world, e.vehicle) for e in episodes] == [(w, f"vehicle_{i + 1}") for w in range(2) for i in range(4)]
    env = coopenv.parallel_env(FOUR_WAY, overrides=OVERRIDES)
    for world in range(2):
        mine = {e.vehicle: e for e in episodes if e.world == world}
        observations, infos = env.reset(seed=5, options={"world": world})
        for name, episode in mine.items():
            assert np.array_equal(episode.observations[0], observations[name])
            assert episode.position_error[0] == pytest.approx(infos[name]["position_error"])
        step = 0
        while env.agents:
            actions = {name: follow(observations[name][None])[0].astype(np.float32) for name in env.agents}
            observations, rewards, terminated, truncated, infos = env.step(actions)
            for name, reward in rewards.items():
                episode = mine[name]
                assert np.array_equal(episode.observations[step + 1], observations[name])
                assert np.array_equal(episode.actions[step], actions[name])
                assert episode.rewards[step] == pytest.approx(reward)
                assert episode.terminations[step] == terminated[name] and episode.truncations[step] == truncated[name]
                assert (len(episode.rewards) == step + 1) == (terminated[name] or truncated[name])
            step += 1
    assert any(e.terminations[-1] for e in episodes) and any(e.truncations[-1] for e in episodes)


def test_lengths_agree_and_agents_drive() -> None:
    scenario = coopenv.load_scenario("facade")
    for episode in drive_vehicles(scenario, load_agent("route_follower", scenario), 0, 3):
        steps = len(episode.rewards)
        assert episode.observations.shape == (steps + 1, coopenv.parallel_env("facade").engine.layout.size)
        assert episode.actions.shape == (steps, 2) and episode.position_error.shape == (steps + 1,)
        assert not (episode.terminations | episode.truncations)[:-1].any()
        assert episode.terminations[-1] or episode.truncations[-1]


def test_prescribed_motion_has_no_episodes() -> None:
    with pytest.raises(CoopenvError, match="nothing to drive"):
        drive_vehicles(coopenv.load_scenario("busy_intersection"), follow, 0, 1)


IDENTITY = "coopenv/facade/route_follower-v0"


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pytest.importorskip("minari", reason="needs the extra minari")
    pytest.importorskip("h5py", reason="needs the extra minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


def test_a_dataset_holds_the_episodes(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import minari

    assert main(["dataset", "facade", "--worlds", "3", "--seed", "7"]) == 0
    assert "3 episodes" in capsys.readouterr().out
    dataset = minari.load_dataset(IDENTITY)
    scenario = coopenv.load_scenario("facade")
    driven = drive_vehicles(scenario, load_agent("route_follower", scenario), 7, 3)
    assert dataset.total_episodes == 3 and dataset.total_steps == sum(len(e.rewards) for e in driven)
    for number, (read, own) in enumerate(zip(dataset.iterate_episodes(), driven, strict=True)):
        for name in ("observations", "actions", "rewards", "terminations", "truncations"):
            assert np.array_equal(getattr(read, name), getattr(own, name)), name
        assert np.array_equal(read.infos["position_error"], own.position_error)
        (facts,) = dataset.storage.get_episode_metadata([number])
        assert facts["options"] == {"world": number, "vehicle": 1}
    env = dataset.recover_environment()
    assert env.observation_space == dataset.spec.observation_space and env.action_space == dataset.spec.action_space
    assert list(minari.list_local_datasets()) == [IDENTITY]
    assert sorted(path.name for path in root.rglob("*") if path.is_file()) == ["main_data.hdf5", "metadata.json"]


def test_a_dataset_that_is_there_is_kept_unless_forced(root: Path) -> None:
    import minari

    arguments = ["dataset", "facade", "--set", "horizon=2.0", "--id", "own/short-v3", "--worlds"]
    assert main([*arguments, "2"]) == 0
    assert "exists already" in refused(*arguments, "4")
    assert minari.load_dataset("own/short-v3").total_episodes == 2
    assert main([*arguments, "4", "--force"]) == 0
    assert minari.load_dataset("own/short-v3").total_episodes == 4
    env = minari.load_dataset("own/short-v3").recover_environment()
    assert env.unwrapped.scenario.horizon == 2.0


def test_a_dataset_of_several_vehicles_is_recovered_with_its_spaces(root: Path) -> None:
    """Its environment drives one of them; overrides that change the spaces are part of it. A file is not registered."""
    import minari

    two = ["dataset", "lighthouse", "--worlds", "2", "--set", "horizon=2.0", "--set", "observation.planar=false"]
    assert main([*two, "--id", "own/two-v0"]) == 0
    dataset = minari.load_dataset("own/two-v0")
    env = dataset.recover_environment()
    assert sum(env.unwrapped.scenario.acting) > 1 and dataset.total_episodes > 2
    assert env.observation_space == dataset.spec.observation_space and env.action_space == dataset.spec.action_space
    assert registered_spec("own.toml") is None and registered_spec("ring:2").kwargs["name_or_path"] == "ring:2"


def test_a_full_disk_is_found_before_anything_is_written(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """HDF5 itself would end the process."""
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=100_000))
    error = refused("dataset", "facade", "--worlds", "2")
    assert "the dataset may need" in error and "0.1 MiB are free" in error
    assert not list(root.iterdir())


def test_a_log_gives_its_recorded_episode(root: Path, tmp_path: Path) -> None:
    import minari

    log = tmp_path / "drive.mcap"
    assert main(["record", "facade", "--set", "horizon=1.0", "--out", str(log), "--no-scene"]) == 0
    assert "--worlds: recorded data have one world" in refused("dataset", str(log), "--worlds", "2")
    assert main(["dataset", str(log)]) == 0
    dataset = minari.load_dataset("coopenv/drive/recorded-v0")
    run, velocity = next(dataset.iterate_episodes()), read_recording(log).velocity[1:, 0]
    np.testing.assert_allclose(run.actions[:, :3], velocity, rtol=1e-6)


@pytest.mark.parametrize("identity", ["no_version", "../out-v0", "a b-v0", "-v0"])
def test_identities_that_are_none_are_refused(identity: str, root: Path) -> None:
    assert "expected NAMESPACE/NAME-v0" in refused("dataset", "facade", f"--id={identity}")
    assert not list(root.iterdir())


@pytest.mark.parametrize(
    ("changes", "note"),
    [
        ({}, "noise on"),
        ({"noise.enabled": False}, "noise off"),
        ({"noise.bearing.scale": 0.0}, "no noise is set for bearings"),
        (
            {"noise.bearing.scale": 0.0, "noise.velocity": 0.0, "noise.angular_velocity": 0.0},
            "no noise is set for bearings and odometry",
        ),
    ],
)
def test_the_header_of_a_run_names_sensors_without_noise(changes: dict[str, Any], note: str) -> None:
    assert noise_note(coopenv.load_scenario("busy_intersection", changes)) == note
