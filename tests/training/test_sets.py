"""A network over sets: the same in NumPy and torch, any number of rows in any order, a driver for many environments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")

import torch

from coopenv import load_scenario
from coopenv.api.engine import Engine
from coopenv.base.errors import AgentWarning, CoopenvError
from coopenv.evaluation.episodes import play
from coopenv.policies import find_agent, load_agent
from coopenv.policies.loader import read_card
from coopenv.policies.sets import CONSTANTS, Inputs, SavedSetDriver, SetDriver
from coopenv.training.command import Reports, train
from coopenv.training.sets import SetNetwork
from coopenv.training.settings import Clone, EvaluationSettings, Ppo, Settings, TrainingPlan

pytestmark = pytest.mark.train
EVERYWHERE = ("facade", "behind_truck", "lighthouse")
ALONE, COLUMNS = 18, (7, 11)
SETTINGS = Settings(
    network="sets",
    steps=0,
    ppo=Ppo(hidden=(32, 32)),
    clone=Clone(agent="look_ahead", episodes=1, epochs=2, elsewhere=EVERYWHERE),
    evaluation=EvaluationSettings(final_worlds=2, drivers=()),
)
PLAN = TrainingPlan("facade", SETTINGS, 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sets") / "agent"
    lines: list[str] = []
    found = train(PLAN, out, reports=Reports(cloning=lines.append))
    assert {result.metric for result in found} >= {"arrival_rate", "e95_m"}
    assert lines[:2] == ["judging look_ahead", "behind_truck (1 of 2): watching look_ahead: 0 of 40 s"]
    assert "lighthouse (2 of 2): watching look_ahead: 0 of 40 s" in lines
    assert lines[-2:] == [f"learning from look_ahead: pass {done} of 2" for done in (1, 2)]
    return out


@pytest.fixture
def drawn() -> tuple[SetDriver, Inputs, torch.Tensor]:
    """Return a driver with drawn weights, drawn inputs, and torch's steering angles for them."""
    generator = np.random.default_rng(0)
    torch.manual_seed(0)
    network = SetNetwork(ALONE, COLUMNS, 16)
    scales = {"mean": generator.normal(size=ALONE), "std": generator.uniform(0.5, 2.0, ALONE)}
    weights = {**scales, **{name: values.numpy() for name, values in network.state_dict().items()}}
    alone = generator.normal(size=(50, ALONE))
    sets = [generator.normal(size=(50, count, width)) for count, width in zip((5, 3), COLUMNS, strict=True)]
    for rows in sets:
        rows[..., 0] = 1.0
        rows[generator.uniform(size=rows.shape[:2]) < 0.4] = 0.0
    normal = (alone - scales["mean"]) / scales["std"]
    with torch.no_grad():
        expected = network(*(torch.from_numpy(values).float() for values in (normal, *sets)))
    return SetDriver(load_scenario("facade"), weights), (alone, sets[0], sets[1]), expected


def test_numpy_agrees_with_torch(drawn: tuple[SetDriver, Inputs, torch.Tensor]) -> None:
    driver, inputs, expected = drawn
    assert driver.steer(inputs) == pytest.approx(expected.numpy(), abs=1e-5)
    assert np.ptp(expected.numpy()) > 0.05


def test_neither_order_nor_absent_rows_matter(drawn: tuple[SetDriver, Inputs, torch.Tensor]) -> None:
    driver, (alone, landmarks, cars), _ = drawn
    more = np.concatenate([np.zeros((50, 4, COLUMNS[1])), cars[:, ::-1]], axis=1)
    assert driver.steer((alone, landmarks[:, ::-1], more)) == pytest.approx(driver.steer((alone, landmarks, cars)))


def inputs_soon(**overrides: object) -> Inputs:
    scenario = load_scenario("open_square", {name.replace("__", "."): value for name, value in overrides.items()})
    engine = Engine(scenario, 4)
    for _ in play(engine, [1, 2, 3, 4], 9):  # ticks, until messages have arrived
        pass
    rows = engine.view("observation").reshape(16, -1)
    return SetDriver(scenario, {}).inputs(rows, np.arange(16) % 4)


def test_inputs_have_units_whatever_the_scales() -> None:
    usual, other = inputs_soon(), inputs_soon(observation__map_scale=11.0, observation__scales={})
    for before, after in zip(usual, other, strict=True):
        np.testing.assert_allclose(after, before, atol=1e-5)
    alone, landmarks, cars = usual
    assert (alone.shape, landmarks.shape, cars.shape) == ((16, ALONE), (16, 6, 7), (16, 3, 12))
    np.testing.assert_allclose(np.linalg.norm(landmarks[..., 1:3], axis=-1), landmarks[..., 3], atol=1e-6)
    assert alone[:, -len(CONSTANTS)] == pytest.approx(1.0)  # m/s, the top speed
    assert (cars[::4, :, -1] == 0.0).all() and cars[::4, :, 0].any()  # the first vehicle gives way to none


def test_the_trained_environment_is_left_out() -> None:
    assert [plan.environment for plan in PLAN.watched()] == ["behind_truck", "lighthouse"]
    assert [plan.environment for plan in replace(PLAN, environment="open_square").watched()] == [*EVERYWHERE]


@pytest.mark.parametrize(
    ("environment", "overrides"),
    [("facade", {}), ("lighthouse", {"observation.map_size": 9}), ("open_square", {"observation.map_scale": 20.0})],
)
def test_the_driver_drives_anywhere(folder: Path, environment: str, overrides: dict[str, object]) -> None:
    scenario = load_scenario(environment, overrides)
    policy, engine = load_agent(folder, scenario), Engine(scenario, 3)
    engine.reset([1, 2, 3])
    rows = engine.view("observation").reshape(3 * len(scenario.vehicles), -1)
    actions = policy(rows)
    assert actions.shape == (len(rows), 2) and np.isfinite(actions).all()
    assert len({round(float(angle), 6) for angle in actions[:, 1]}) > 1


def test_warns_beyond_the_constants_of_its_training(folder: Path) -> None:
    with pytest.warns(AgentWarning, match=r"agent agent: 'range' is 19 to 19 here, and was 4\.75 to 5\.7 in its tra"):
        load_agent(folder, load_scenario("facade", {"camera.range": 20.0}))


def test_other_weights_are_refused(folder: Path) -> None:
    card = read_card(folder).network
    foreign = find_agent("take_turns_team")
    assert card and foreign.folder and foreign.network
    other = card.model_copy(update={"sha256": foreign.network.sha256})
    with pytest.raises(CoopenvError, match=r"weights\.safetensors: not the weights of a network over sets: 'mean'"):
        SavedSetDriver(load_scenario("facade"), folder=foreign.folder, network=other)


def test_impossible_settings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CoopenvError, match=r"--onnx: not with network = 'sets'"):
        train(PLAN, tmp_path / "agent", onnx=True)
    clone = Clone(agent="look_ahead", elsewhere=("nowhere",))
    with pytest.raises(CoopenvError, match=r"network: the observation lacks last_action"):
        train(replace(PLAN, overrides={"observation.exclude": ["last_action"]}), tmp_path / "agent")
    other = Clone(agent="look_ahead", elsewhere=("crossing_path", "nowhere"))
    with pytest.raises(CoopenvError, match=r"clone\.elsewhere: crossing_path: agent .look_ahead. cannot be"):
        train(replace(PLAN, settings=SETTINGS.model_copy(update={"clone": other})), tmp_path / "agent")
    with pytest.raises(CoopenvError, match=r"clone\.elsewhere: nowhere: .*'nowhere'"):
        train(replace(PLAN, settings=SETTINGS.model_copy(update={"clone": clone})), tmp_path / "agent")
    assert not [*tmp_path.iterdir()]
