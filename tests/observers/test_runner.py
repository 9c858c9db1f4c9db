"""Inputs of an observer, their times, and the use of its results."""

from __future__ import annotations

import re
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv.observers.registry as registry
from coopenv import CoopenvError
from coopenv.observers import (
    Coordinates,
    Estimate,
    Message,
    Observer,
    Recording,
    Setup,
    Tick,
    find,
    list_observers,
    register,
    run,
)
from coopenv.observers.group import ObserverGroup
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers.recordings import completed
from tests.helpers.recordings import simulated as recording
from tests.oracles.batch import small_errors

NAMES = sorted({*registry.zoo()} & {*registry.available_names()})


class Probe:
    """Stands still and notes what it is given; its message says when it was made."""

    seen: ClassVar[list[tuple[str, Tick]]] = []

    def __init_subclass__(cls) -> None:
        cls.seen = []

    def __init__(self, setup: Setup) -> None:
        self.setup, self.index = setup, 0

    def reset(self, initial_pose: tuple[np.ndarray, np.ndarray], initial_covariance: np.ndarray) -> None:
        self.R, self.p = initial_pose

    def update(self, tick: Tick) -> Estimate:
        self.index = tick.index
        type(self).seen.append((self.setup.name, tick))
        return Estimate(self.R, self.p)

    def message(self) -> Message:
        return Message(position=self.p, extra={"index": np.array([float(self.index)])})


def probe(record_: Recording) -> list[tuple[str, Tick]]:
    class Mine(Probe):
        pass

    assert isinstance(Mine(record_.setups[0]), Observer)
    completed(Mine, record_)
    return Mine.seen


def test_without_delay_a_leader_is_received_in_the_same_tick() -> None:
    seen = probe(recording())
    assert len(seen) == 60 * 5
    for _, tick in seen:
        vehicles = [int(t) for t in tick.targets if t >= 3]
        assert sorted(tick.messages) == vehicles
        assert all(m.age == 0.0 and m.message.extra["index"][0] == tick.index for m in tick.messages.values())
        assert_allclose(np.linalg.norm(tick.bearings[tick.valid], axis=1), 1.0)
    assert {name for name, _ in seen} == {f"vehicle_{i}" for i in range(1, 6)}


def test_bearings_are_in_the_body_frame_and_point_to_the_target() -> None:
    scenario = load_scenario(
        "busy_intersection", {"horizon": 0.1, "noise.enabled": False, "camera.orientation": "forward"}
    )
    made = record(scenario, 0)
    for name, tick in probe(made):
        R, p = made.truth.rotation[tick.index, int(name[-1]) - 1], made.truth.position[tick.index, int(name[-1]) - 1]
        for n, target in enumerate(tick.targets):
            z = tick.landmarks[target] if target < 3 else made.truth.position[tick.index, target - 3]
            line = R.T @ (z - p)
            assert_allclose(tick.bearings[n], line / np.linalg.norm(line), atol=1e-12)


def test_rounded_pixels_are_in_the_declared_noise() -> None:
    """Of a single car that drives by five landmarks, so that pixels change."""
    made = record(load_scenario("crossing_path", {"horizon": 20.0}), 0)
    R, p = made.truth.rotation[:, 0], made.truth.position[:, 0]
    lines = (made.landmarks - p[:, None]) @ R - made.setups[0].lever_arm
    true = lines / np.linalg.norm(lines, axis=-1, keepdims=True)
    errors = (made.bearings[:, 0, :5] - true)[made.visible[:, 0, :5]]
    per_axis = np.sqrt(np.mean(np.sum(errors**2, axis=-1)) / 2)
    assert_allclose(per_axis, made.setups[0].noise.bearing, rtol=0.1)


def test_arrays_of_another_length_or_precision() -> None:
    made = recording(horizon=0.2)
    assert replace(made, rotation=made.rotation.astype(np.float32)).rotation.dtype == np.float64
    with pytest.raises(CoopenvError, match=r"^translation: expected an array of shape"):
        run("robust", replace(made, translation=made.translation[:-1]))


@pytest.mark.parametrize("name", NAMES)
def test_no_bearing_need_fit(name: str) -> None:
    """Not even one of a frame, for any observer."""
    made = recording("lane:3")
    drawn = np.random.default_rng(0).standard_normal(made.bearings.shape)
    random = np.where(made.visible[..., None], drawn / np.linalg.norm(drawn, axis=-1, keepdims=True), made.bearings)
    completed(name, replace(made, bearings=random))


def test_odometry_without_noise_is_the_true_motion() -> None:
    scenario = small_errors({"horizon": 0.5, "noise.enabled": False})
    made = record(scenario, 0)
    result = run(
        "dead_reckoning", replace(made, start_rotation=made.truth.rotation[0], start_position=made.truth.position[0])
    )
    assert result.position_error.max() < 1e-10
    assert result.orientation_error.max() < 1e-8


@pytest.mark.parametrize("name", NAMES)
def test_truth_does_not_leak(name: str) -> None:
    made = recording(horizon=0.2)
    lie = replace(made.truth, rotation=made.truth.rotation[:, ::-1], position=made.truth.position + 100.0)
    honest, lied = completed(name, made), run(name, replace(made, truth=lie))
    assert (honest.position == lied.position).all() and (honest.rotation == lied.rotation).all()
    assert (honest.position_error[1:] != lied.position_error[1:]).all()


@pytest.mark.parametrize(
    ("name", "each"), [("riccati", 24), ("mekf", 24), ("mekf_covariance", 72), ("hamel_samson", 0)]
)
def test_bytes_are_counted(name: str, each: int) -> None:
    assert_allclose(run(name, recording(horizon=0.2)).bytes_per_second, each * 60.0)
    assert_allclose(run(name, recording(horizon=0.2, v2x__period=2)).bytes_per_second, each * 30.0)


def test_size_of_messages() -> None:
    pose = {"position": np.zeros(3), "rotation": np.eye(3)}
    assert Message().size_bytes == 0
    assert Message(**pose).size_bytes == 56
    assert Message(**pose, covariance=np.eye(6)).size_bytes == 56 + 168
    assert Message(extra={"a": np.zeros((2, 5))}).size_bytes == 80


def test_failures_end_in_a_word_not_in_a_crash() -> None:
    class Breaks(Probe):
        def update(self, tick: Tick) -> Estimate:
            if tick.index == 6 and self.setup.name == "vehicle_3":
                raise ZeroDivisionError("no gain")
            return super().update(tick)

    result = run(Breaks, recording())
    assert re.fullmatch(r"at vehicle_3 at 0\.100 s: ZeroDivisionError: no gain \(test_runner\.py:\d+\)", result.failure)
    assert np.isfinite(result.position_error[6, :2]).all()
    assert np.isnan(result.position_error[6:, 2:]).all() and np.isnan(result.position_error[7:]).all()


class UnspeakableError(Exception):
    def __str__(self) -> str:
        return str(1 // 0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda e: sys.exit(3), "SystemExit: 3"),
        (lambda e: (_ for _ in ()).throw(BaseException("odd")), "BaseException: odd"),
        (lambda e: (_ for _ in ()).throw(ValueError("one\nand two")), "ValueError: one and two"),
        (lambda e: None, "update returned None, expected an Estimate"),
        (lambda e: (e.rotation, e.position), "update returned (array("),
        (lambda e: replace(e, position=e.position[None]), "position is not a finite array of shape (3,)"),
        (lambda e: replace(e, position=e.position * np.nan), "position is not a finite array of shape (3,)"),
        (lambda e: (_ for _ in ()).throw(UnspeakableError()), "UnspeakableError: no message: its text raises"),
        (lambda e: (_ for _ in ()).throw(ValueError("\x1b[2J" + "a" * 5000)), "ValueError: \\x1b[2Jaaa"),
        (lambda e: replace(e, nis="small", nis_dof=2), "TypeError"),
    ],
)
def test_invalid_estimates_are_one_error_line(change: Any, said: str) -> None:
    class Odd(Probe):
        def update(self, tick: Tick) -> Estimate:
            return change(super().update(tick))

    failure = run(Odd, recording()).failure
    assert "at vehicle_1 at 0.017 s" in failure and said in failure and "\n" not in failure


def test_a_sent_message_does_not_change_any_more() -> None:
    class Careless(Probe):
        def __init__(self, setup: Setup) -> None:
            super().__init__(setup)
            self.buffer = np.zeros(3)

        def message(self) -> Message:
            self.buffer[:] = self.index
            return Message(position=self.buffer)

    run(Careless, recording(v2x__delay=3))
    late = [tick for name, tick in Careless.seen if name == "vehicle_2" and tick.index == 20]
    assert late[0].messages[3].message.position is not None
    assert late[0].messages[3].message.position[0] == 17.0


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        ([1, 2, 3], "message returned [1, 2, 3], expected a Message"),
        (Message(np.full(3, np.nan)), "message: position is not a finite array of shape (3,) with numbers up to 1e+09"),
    ],
)
def test_invalid_messages_are_one_error_line(odd: Any, said: str) -> None:
    class Odd(Probe):
        def message(self) -> Any:
            return odd if self.index == 6 else super().message()

    assert run(Odd, recording()).failure.endswith(f"at 0.100 s: CoopenvError: {said}")


def test_an_observer_that_cannot_be_built_ends_its_run() -> None:
    class Unwilling(Probe):
        def __init__(self, setup: Setup) -> None:
            raise CoopenvError(f"no observer for {setup.name}")

    assert run(Unwilling, recording()).failure == "at vehicle_1 at 0.000 s: CoopenvError: no observer for vehicle_1"


@pytest.mark.parametrize(("former", "name"), sorted(registry.REPLACED.items()))
def test_a_former_name_warns_and_gives_the_successor(former: str, name: str) -> None:
    with pytest.warns(DeprecationWarning, match=f"observer '{former}' is now '{name}'"):
        assert registry.find(former) is registry.find(name)
    with pytest.warns(DeprecationWarning, match=f"'{name}'"):
        assert registry.with_observer({}, former) == {"observer.name": name}
    registry.check_known(former)
    assert former not in registry.list_observers()


SENSED = ("rotation", "translation", "velocity", "angular_velocity", "targets", "bearings", "valid", "landmarks")


@pytest.mark.parametrize("name", [*SENSED, "lever_arm"])
def test_sensed_values_are_read_only(name: str) -> None:
    class Vandal(Probe):
        def update(self, tick: Tick) -> Estimate:
            getattr(tick, name)[:] = 0
            return super().update(tick)

    assert "read-only" in run(Vandal, recording()).failure


@pytest.mark.parametrize("restored", [False, True])
def test_messages_to_all_receivers_are_read_only(restored: bool) -> None:
    made = recording()
    group = ObserverGroup(Probe, made.observer_init)
    group.start(made.start_rotation, made.start_position)
    sensed = made.at(1)
    for i in made.order:
        group.update(i, sensed, made.inbox_tick[1, i])
    if restored:
        group.set_state(group.checked_state(group.get_state(), begun=True))
    heard = [r.message for i in made.order for r in group.mail.inbox(1, i, made.inbox_tick[1, i]).values()]
    assert heard
    for message in heard:
        assert message.position is not None and not message.position.flags.writeable
        assert not message.extra["index"].flags.writeable


def test_a_restored_group_refuses_what_it_would_have_refused() -> None:
    """Covariances of another shape than a vehicle's own, also before it has sent again."""
    made = recording("busy_intersection_tracking", v2x__period=3, v2x__delay=0)

    def tamper(vehicle: int, time: float, observer: Observer, message: Message) -> Message:
        return replace(message, covariance=np.eye(6)) if vehicle == 1 else message

    groups = [ObserverGroup(find("mekf_covariance"), made.observer_init, tamper) for _ in range(2)]
    for group in groups:
        group.start(made.start_rotation, made.start_position)
    for k in range(1, 13):
        if k == 9:
            groups[1].set_state(groups[1].checked_state(groups[1].get_state(), begun=True))
        for group in groups:
            for i in made.order:
                group.update(i, made.at(k), made.inbox_tick[k, i])
    assert groups[0].refused.tolist() == groups[1].refused.tolist() and groups[0].refused.any()


def test_the_mean_nees_is_over_the_ticks_with_a_covariance() -> None:
    class Sometimes(Probe):
        def update(self, tick: Tick) -> Estimate:
            estimate = super().update(tick)
            return replace(estimate, covariance=np.eye(6)) if tick.index % 3 == 0 else estimate

    class Breaks(Sometimes):
        def update(self, tick: Tick) -> Estimate:
            return 1 / 0 if tick.index == 40 else super().update(tick)

    result = run(Sometimes, recording())
    assert_allclose(result.anees(), result.nees[3::3].mean(axis=0) / 6)
    assert np.isfinite(run("mekf", recording()).anees()).all()
    assert np.isnan(run(Probe, recording()).anees()).all()
    assert np.isnan(run(Breaks, recording()).anees()).all()


def test_errors_in_every_coordinates_are_about_the_same_thing() -> None:
    """NEES of a far estimate by the definitions, and a wrong choice of coordinates shows."""
    made = recording()
    result = run("mekf", made)
    k, i = 30, 2
    R, p = made.truth.rotation[k, i], made.truth.position[k, i]
    e = Coordinates.LEFT.error(R, p, result.rotation[k, i], result.position[k, i])
    assert_allclose(result.nees[k, i], e @ np.linalg.inv(result.covariance[k, i]) @ e, rtol=1e-6)
    assert result.coordinates is Coordinates.LEFT and run("right_invariant", made).coordinates is Coordinates.RIGHT


def test_honest_filters_are_consistent() -> None:
    """The centralised filter's NEES is that of its dimension: 4 seeds, 5 vehicles, correlated in time."""
    scenario = small_errors(
        {"horizon": 2.0, "noise.bearing.scale": 0.003, "rates.odometry": 60.0}, size=0.1, turning=False
    )
    mean = np.mean([run("centralised", record(scenario, seed)).anees(0.5) for seed in range(4)])
    assert 0.7 < mean < 1.4


def test_drawn_starts_have_the_stated_covariance() -> None:
    scenario = small_errors({"horizon": 1 / 60}, size=0.4, turning=False)
    errors = []
    for seed in range(60):
        made = record(scenario, seed)
        R, p = made.truth.rotation[0], made.truth.position[0]
        errors.append(Coordinates.LEFT.error(R, p, made.start_rotation, made.start_position))
    measured = np.mean(np.concatenate(errors) ** 2, axis=0)
    assert_allclose(measured, np.diag(made.start_covariance[0]), rtol=0.25)


def test_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CoopenvError, match="did you mean 'riccati'"):
        find("ricati")
    monkeypatch.setattr(registry, "_registered", {})
    register("mine", Probe)
    assert find("mine") is Probe and "mine" in list_observers()
    register("mine", Probe)
    for name in ("mine", "riccati"):
        with pytest.raises(CoopenvError, match="exists already"):
            register(name, Message)
    for odd in (5, "", "a,b", "a b", "all\n", "a" * 1000):
        with pytest.raises(CoopenvError, match="an observer's name is"):
            register(odd, Probe)  # type: ignore[arg-type]
    with pytest.raises(CoopenvError, match="'x': expected a class or function, got 3"):
        register("x", 3)
    assert "x" not in list_observers()


def test_observers_that_were_merely_used_are_known_and_not_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    for known, empty in (("_registered", {}), ("_places", {}), ("_listed", set())):
        monkeypatch.setattr(registry, known, empty)
    assert registry.named(Probe) == "Probe" and find("Probe") is Probe
    assert "Probe" not in list_observers() and "Probe" in registry.available_names()
    with pytest.raises(CoopenvError, match="unknown observer") as caught:
        find("nosuch")
    assert "Probe" not in str(caught.value)
    register("Probe", Probe)
    assert "Probe" in list_observers()


def test_observers_of_installed_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    from importlib.metadata import EntryPoint

    group, places = "coopenv.observers", {"theirs": f"{__name__}:Probe", "broken": "no_such_module:Thing"}
    points = {name: EntryPoint(name, place, group) for name, place in places.items()}
    monkeypatch.setattr(registry, "offered", lambda asked: points if asked == group else {})
    assert find("theirs") is Probe
    with pytest.raises(CoopenvError, match=r"'broken'.*cannot be loaded.*no_such_module"):
        find("broken")
    assert "broken" in list_observers() and "broken" not in registry.available_names()
    assert "theirs" in registry.available_names() and not registry.obstacle("theirs")
    assert "no_such_module" in registry.obstacle("broken") and "\n" not in registry.obstacle("broken")


@pytest.mark.slow
def test_the_example_is_better_than_odometry(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(registry, "_registered", {})
    runpy.run_path(str(Path(__file__).parents[2] / "examples" / "own_observer.py"), run_name="__main__")
    rows = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines()[1:]}
    own, odometry = (np.array(rows[name][:5], float) for name in ("my_ekf", "dead_reckoning"))
    assert (own < 0.1).all() and (own < 0.1 * odometry).all()
    assert float(rows["my_ekf"][5]) == (3 + 6) * 8 * 60
