"""Habits of users of PettingZoo, Gymnasium and notebooks: they work, or one line names the alternative."""

from __future__ import annotations

import copy
import json
import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, get_type_hints

import gymnasium
import numpy as np
import pettingzoo
import pytest

import coopenv
from coopenv.api.arguments import Info
from coopenv.base.errors import Explained
from coopenv.base.files import replace_text
from coopenv.cli.app import main
from coopenv.policies import load_agent
from coopenv.runs import record, rollout
from coopenv.scenario import Scenario
from tests.helpers.commands import refused
from tests.helpers.four_way import FOUR_WAY

ENV = "facade"


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return coopenv.load_scenario(ENV, {"horizon": 0.5})


def kinds(scenario: Scenario) -> dict[str, Any]:
    return {
        "scenario": scenario,
        "dict": scenario.model_dump(),
        "JSON": json.loads(scenario.model_dump_json(exclude_unset=True)),
        "changed copy": coopenv.load_scenario(ENV) | {"horizon": 0.5},
    }


@pytest.mark.parametrize("kind", ["scenario", "dict", "JSON", "changed copy"])
def test_whatever_stands_for_a_scenario_goes_everywhere(scenario: Scenario, kind: str) -> None:
    given = kinds(scenario)[kind]
    with coopenv.parallel_env(given) as env, coopenv.make_vec(given, num_worlds=1) as batch:
        observations, _ = env.reset(seed=4)
        rows, _ = batch.reset(seed=4)
        np.testing.assert_array_equal(rows[0], observations["vehicle_1"])
        assert env.scenario == batch.scenario == scenario
    np.testing.assert_array_equal(rollout(given, seed=4).position, coopenv.run(given, seed=4).trajectory.position)
    assert rollout(given, overrides={"horizon": 0.2}).t[-1] == pytest.approx(0.2)
    assert len(record(given, seed=4).t) == 1 + scenario.horizon_ticks
    if kind == "dict":
        assert coopenv.compare(["dead_reckoning"], given, seeds=1).environment == "Facade"
        assert list(coopenv.evaluate(given, ["peek"], worlds=2).episodes) == ["peek"]


def test_paths_and_scenes_are_names_as_well() -> None:
    whole = coopenv.load_scenario(FOUR_WAY)
    assert coopenv.parallel_env(Path(FOUR_WAY)).scenario == whole
    assert repr(coopenv.make_vec("lane:3", num_worlds=2)).startswith(
        "CooperativeVectorEnv('lane:3', worlds=2, vehicles=3"
    )


def test_an_environment_prints_copies_pickles_and_closes() -> None:
    env = coopenv.parallel_env(ENV)
    assert (
        repr(env) == "CooperativeLocalisationEnv('facade', vehicles=1, landmarks=14, observer='robust', horizon=40.0)"
    )
    assert "<img" not in env._repr_html_()  # nothing has begun
    assert len(env) == 1 and len(coopenv.make_vec("lane:3", num_worlds=2)) == 6
    assert (env.unwrapped, env.agents, env.max_num_agents) == (env, [], 1)
    assert copy.deepcopy(env).agents == []  # before the first reset
    env.reset(seed=np.int64(3))
    assert "data:image/png;base64," in env._repr_html_()
    action = {"vehicle_1": [0.5, 0.0]}
    expected = env.get_state()["tick"]
    for other in (copy.deepcopy(env), copy.copy(env), pickle.loads(pickle.dumps(env))):
        np.testing.assert_array_equal(other.get_state()["tick"], expected)
    ahead = copy.deepcopy(env)
    np.testing.assert_array_equal(ahead.step(action)[0]["vehicle_1"], env.step(action)[0]["vehicle_1"])
    env.close()
    env.close()
    env.reset(seed=3)


@pytest.mark.parametrize("name", ["facade", "lane:20", "take_turns", "crossing_path"])
def test_a_scenario_has_a_picture(name: str) -> None:
    scenario = coopenv.load_scenario(name)
    assert "data:image/png;base64," in scenario._repr_html_()
    map_of = scenario.figure().axes[0]
    starts = map_of.collections[-2]
    assert len(starts.get_paths()) == len(scenario.vehicles)  # type: ignore[attr-defined]
    low, high = np.array([map_of.get_xlim(), map_of.get_ylim()]).T
    for path in starts.get_paths():  # type: ignore[attr-defined]
        assert (path.vertices > low).all() and (path.vertices < high).all()


def test_an_observation_without_an_entry_is_refused() -> None:
    with pytest.raises(coopenv.CoopenvError, match=r"^observation.include: seen without an entry here; add a group"):
        coopenv.parallel_env("facade", overrides={"observation.include": ["seen"]})


def test_a_state_whose_lists_never_end_is_refused() -> None:
    env = coopenv.parallel_env(ENV)
    env.reset(seed=0)
    state = env.get_state()
    state["next_item"][0, :2] = [1, 0]
    with pytest.raises(coopenv.CoopenvError, match=r"'next_item' at \(0, 0\)"):
        env.set_state(state)
    single = coopenv.parallel_env("lane:3")  # whose grid is a single cell, without lists
    single.reset(seed=0)
    state = single.get_state()
    single.set_state({**state, "next_item": 0 * state["next_item"]})


def test_infos_have_the_entries_that_their_type_names() -> None:
    env = coopenv.parallel_env("urban_crossing")
    _, infos = env.reset(seed=0)
    hints = get_type_hints(Info)
    for info in infos.values():
        assert info.keys() == hints.keys() - {"car"}
        assert type(info["position_error"]) is float and type(info["visible"]) is tuple
        assert info["estimate"].keys() == get_type_hints(hints["estimate"]).keys()


def test_items_of_an_info_are_its_numbers() -> None:
    """Trainers make tensors of them; words and tables stay entries by name, in copies too."""
    env = coopenv.parallel_env("crossing_path")
    _, infos = env.reset(seed=0)
    first = {name: np.shape(value) for name, value in infos["vehicle_1"].items()}
    _, _, _, _, infos = env.step({agent: np.zeros(2) for agent in env.agents})
    info = infos["vehicle_1"]
    numbers = {name: np.asarray(value) for name, value in info.items()}
    assert first == {name: value.shape for name, value in numbers.items()}
    assert all(value.dtype.kind in "fi" for value in numbers.values()) and "nees" in numbers
    for twin in (copy.deepcopy(info), pickle.loads(pickle.dumps(info)), dict(info), {**info}):
        assert twin.keys() == info.keys() and twin["outcome"] == "under way"
        assert np.array_equal(twin["truth"]["position"], info["truth"]["position"])


def test_a_dict_observation_has_no_empty_boxes() -> None:
    """A vehicle without others has no messages; the flat observation's table has their fields, without entries."""
    env, batch = (
        coopenv.parallel_env("crossing_path", observation="dict"),
        coopenv.make_vec("crossing_path", num_worlds=2, observation="dict"),
    )
    for space in (env.observation_space("vehicle_1"), batch.single_observation_space):
        assert min(part.shape[0] for part in space.values()) > 0
    assert env.observation_space("vehicle_1").contains(env.reset(seed=0)[0]["vehicle_1"])
    assert batch.observation_space.contains(batch.reset(seed=0)[0])
    empty = {name for name, field in env.observation_layout.items() if field.start == field.stop}
    assert env.observation_layout.keys() - env.observation_space("vehicle_1").keys() == empty
    assert "message_mask" in empty


def test_figures_show_in_notebooks_that_have_not_loaded_pyplot(scenario: Scenario) -> None:
    results = coopenv.run(scenario, seed=4)
    for figure in (results.figure(), results.trajectory.figure("errors")):
        assert "data:image/png;base64," in figure._repr_html_()  # type: ignore[attr-defined]


def test_types_of_numpy_are_precisions() -> None:
    assert coopenv.parallel_env(ENV, dtype=np.float64).engine.world.precision.name == "float64"  # type: ignore[arg-type]
    assert coopenv.make_vec(ENV, num_worlds=1, dtype="torch.float64").engine.world.precision.name == "float64"
    with pytest.raises(coopenv.DeviceError, match=r"^unknown dtype 'float16' \(did you mean 'float\d\d'\?\)"):
        coopenv.make_vec(ENV, num_worlds=1, dtype="float16")


def test_one_vehicle_of_a_trajectory(scenario: Scenario) -> None:
    whole = rollout(FOUR_WAY, steps=2)
    np.testing.assert_array_equal(whole["vehicle_3"].position[:, 0], whole.position[:, 2])
    with pytest.raises(coopenv.CoopenvError, match="unknown vehicle 'f3'"):
        whole["f3"]


def test_a_scenario_is_read_by_dotted_keys_and_lists_them() -> None:
    scenario = coopenv.load_scenario(ENV)
    assert scenario["noise.enabled"] is scenario.noise.enabled and scenario["horizon"] == scenario.horizon
    assert pickle.loads(pickle.dumps(scenario)) == copy.deepcopy(scenario) == scenario
    assert "noise.enabled" in scenario and "enabledd" not in scenario.noise and "vehicles.9" not in scenario
    assert "reward.weights.progress" in scenario and "reward.weights.nosuch" not in scenario
    for attempt in (lambda: scenario["noise.enabledd"], lambda: scenario.noise.enabledd):
        with pytest.raises(AttributeError, match=r"^'Noise' object has no attribute 'enabledd' \(did you mean"):
            attempt()
    with pytest.raises(AttributeError, match=r"'to_toml'; .* returns a changed scenario, model_dump\(\) data$"):
        scenario.to_toml()
    with pytest.raises(AttributeError, match=r"^type object 'Scenario' has no attribute 'load'; coopenv\.load_sce"):
        Scenario.load("facade")
    with pytest.raises(AttributeError, match=r"'to_dict' \(did you mean 'model_dump'\?\); keys: "):
        scenario.to_dict()
    assert Scenario(**scenario.model_dump()) == Scenario(**scenario) == scenario
    assert coopenv.load_scenario({**scenario, "horizon": 0.5}) == scenario | {"horizon": 0.5}


def test_a_scenario_is_changed_and_read_by_dotted_keys(scenario: Scenario) -> None:
    changed = scenario | {"noise.enabled": False, "landmarks.1.yaw": 0.3}
    assert scenario["noise.enabled"] and not changed["noise.enabled"]
    name = scenario.landmarks[1].name
    assert changed[f"landmarks.{name}.yaw"] == changed["landmarks.1.yaw"] == 0.3
    with pytest.raises(coopenv.CoopenvError, match=rf"^unknown entry 'nosuch'; known: .*{name}"):
        scenario["landmarks.nosuch"]


@pytest.mark.parametrize("identity", ["coopenv/Facade-v0", "coopenv/facade", "coopenv:coopenv/facade"])
def test_an_environment_is_made_by_its_own_name(identity: str) -> None:
    with gymnasium.make(identity) as env:
        assert env.reset(seed=1)[0].shape == env.observation_space.shape
    if ":" not in identity:
        assert pettingzoo.make("parallel", identity).scenario == coopenv.load_scenario(ENV)


def test_registries_hold_names_of_coopenv_alone_and_make_any_scenario(scenario: Scenario) -> None:
    assert not {*coopenv.list_envs()} & {*gymnasium.registry, *pettingzoo.parallel_registry}
    made: Any = gymnasium.make("coopenv/Scenario-v0", name_or_path=scenario).unwrapped
    assert made.scenario == scenario
    assert gymnasium.make_vec("coopenv/ScenarioRows-v0", num_envs=5, name_or_path="ring:5").num_envs == 5
    assert len(pettingzoo.make("parallel", "coopenv/Scenario-v0", name_or_path="ring:5").possible_agents) == 5


MISTAKES: dict[str, tuple[Callable[[], Any], str]] = {
    "an id": (lambda: coopenv.parallel_env("coopenv/Facade-v0"), r"an id, for gymnasium\.make; .* is 'facade'"),
    "a title": (lambda: coopenv.parallel_env("Facade"), r"did you mean 'facade'\?"),
    "a dash": (lambda: coopenv.make_vec("urban-crossing", num_worlds=1), r"did you mean 'urban_crossing'\?"),
    "None": (lambda: coopenv.parallel_env(None), "^environment: expected a name.*got NoneType"),  # type: ignore[arg-type]
    "arguments in turn": (lambda: coopenv.compare(ENV, "robust"), "'robust' is an observer; observers come first"),
    "an environment": (
        lambda: coopenv.run(coopenv.parallel_env(ENV)),  # type: ignore[arg-type]
        r"got CooperativeLocalisationEnv \(did you mean its attribute scenario\?\)$",
    ),
    "a list": (lambda: coopenv.compare(["riccati"], [ENV]), "^environment: .* got list"),  # type: ignore[arg-type]
    "a set attribute": (
        lambda: setattr(coopenv.load_scenario(ENV), "horizon", 3.0),
        r"^Scenario\.horizon: is frozen; scenario \| \{'dotted\.key': value\} returns a changed scenario",
    ),
    "a folder": (lambda: coopenv.load_scenario("."), r"a folder; expected .*; coopenv view opens that of a run$"),
    "a changed section": (
        lambda: coopenv.load_scenario(ENV).noise | {"enabled": False},  # type: ignore[operator]
        r"^Noise\..* is frozen; scenario \| ",
    ),
    "a constructor": (lambda: Scenario(title="Mine"), r"^Scenario: horizon: Field required"),  # type: ignore[call-arg]
    "a replaced entry": (lambda: coopenv.load_scenario(ENV).__replace__(horizon=-3.0), "greater than 0"),
    "a file of another kind": (lambda: coopenv.run("x.zip"), r"^no such scenario file: x\.zip; expected a scenario "),
    "a number as path": (lambda: replace_text(5, ""), "^path: expected text or a Path, got 5$"),  # type: ignore[arg-type]
    "an unchecked copy": (
        lambda: coopenv.load_scenario(ENV).model_copy(update={"horizon": -3}),
        "horizon: Input should be greater than 0, got -3",
    ),
    "a copy with a typo": (lambda: coopenv.load_scenario(ENV).model_copy(update={"horizn": 3}), "mean 'horizon'"),
    "two observers": (lambda: coopenv.run(ENV, observer="mekf,robust"), r"one at a time; several: coopenv\.compare$"),
    "a missing model": (
        lambda: coopenv.evaluate(ENV, "a.zip"),
        r"^unknown agent 'a\.zip'.*; or a folder with",
    ),
    "covariance of another shape": (
        lambda: coopenv.position_covariance(np.eye(3), np.zeros(3), np.eye(5)),
        r"got \[\(3, 3\), \(3,\), \(5, 5\)\]",
    ),
    "no variant": (lambda: coopenv.compare("mekf", "lane:3", 1, variants=[]), "variants: expected at least one"),
    "a fault that is a number": (lambda: coopenv.compare("mekf", "lane:3", 1, faults=[3]), "expected a text, got 3"),
    "an observer's number": (lambda: coopenv.compare(3, ENV), r"^expected a name, a class or a list"),  # type: ignore[arg-type]
    **{
        f"{jobs!r} jobs": (partial(coopenv.compare, "dead_reckoning", ENV, jobs=jobs), "^jobs: expected a whole number")
        for jobs in (0, -3, 1.5, "x")
    },
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line(mistake: str) -> None:
    attempt, words = MISTAKES[mistake]
    with pytest.raises(coopenv.CoopenvError, match=words) as caught:
        attempt()
    assert "\n" not in str(caught.value)


WRONG_CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "a keyword of Gymnasium": (
        lambda: coopenv.make_vec(ENV, num_envs=2),  # type: ignore[call-arg]
        r"^make_vec\(\) got an unexpected keyword argument 'num_envs' \(did you mean 'num_worlds'\?\); known: ",
    ),
    "a key of the scenario": (
        lambda: coopenv.parallel_env(ENV, horizon=3.0),  # type: ignore[call-arg]
        r"'horizon'; known: name_or_path, .*; keys of a scenario are given in overrides$",
    ),
    "an option of the shell": (lambda: coopenv.run(ENV, set={}), r"^run\(\) .*'set' \(did you mean 'overrides'\?\)"),  # type: ignore[call-arg]
    "seeds": (lambda: coopenv.run(ENV, seeds=3), r"^run\(\) .*; several seeds or observers: coopenv\.compare$"),  # type: ignore[call-arg]
    "through Gymnasium": (lambda: gymnasium.make("coopenv/Facade-v0", observr="mekf"), r"did you mean 'observer'\?"),
    "an agent without its scenario": (
        lambda: load_agent("peek"),  # type: ignore[call-arg]
        r"^load_agent\(\) missing 1 required positional argument: 'scenario'; .*, for example load_agent\('peek', 'fac",
    ),
    "a scenario by position": (
        lambda: Scenario({}),
        r"^Scenario\(\) takes 0 positional arguments but 1 were given; .*load_scenario reads",
    ),
    "render as in OpenAI Gym": (
        lambda: coopenv.parallel_env(ENV).render("human"),
        "render_mode is given where",
    ),
    "reset of a batch by position": (lambda: coopenv.make_vec(ENV, num_worlds=1).reset(3), "by name: seed, options"),
    "unknown argument of reset": (lambda: coopenv.parallel_env(ENV).reset(sede=3), r"did you mean 'seed'"),
    "covariance without position": (lambda: coopenv.position_covariance(np.eye(3), np.eye(6)), r"\*\*info\["),
    "entry of an environment": (lambda: coopenv.parallel_env(ENV)["vehicle_1"], r"reset\(\) and step\(\) return"),
    "row of a batch": (lambda: coopenv.make_vec(ENV, num_worlds=1)[0], r"reset\(\) and step\(\) return"),
}


@pytest.mark.parametrize("mistake", WRONG_CALLS)
def test_a_wrong_call_is_one_line(mistake: str) -> None:
    attempt, words = WRONG_CALLS[mistake]
    with pytest.raises(TypeError, match=words) as caught:
        attempt()
    assert "\n" not in str(caught.value) and "self" not in str(caught.value)


ABSENT: dict[str, tuple[Callable[[], Any], str]] = {
    "make": (lambda: coopenv.make, r"^module 'coopenv' has no attribute 'make' \(did you mean 'parallel_env'\?\)$"),
    "below": (lambda: coopenv.rollout, r"no attribute 'rollout' \(from coopenv\.runs import rollout\)$"),
    "a command": (lambda: coopenv.train, r"no attribute 'train' \(in the shell: coopenv train\)$"),
    "seed": (
        lambda: coopenv.parallel_env(ENV).seed(3),
        r"no attribute 'seed' \(did you mean 'reset'\?\); known: action_space,",
    ),
    "key of the scenario": (
        lambda: coopenv.parallel_env(ENV).horizon,
        r"\(did you mean 'scenario\.horizon'\?\); known",
    ),
    "plot of a scenario": (lambda: coopenv.load_scenario(ENV).plot(), r"\(did you mean 'figure'\?\); keys: "),
    "plot": (
        lambda: coopenv.run(ENV, overrides={"horizon": 0.3}).plot(),  # type: ignore[attr-defined]
        r"^'Results' object has no attribute 'plot' \(did you mean 'figure'\?\); known: columns, .*trajectory$",
    ),
}


@pytest.mark.parametrize("name", ABSENT)
def test_an_attribute_that_is_not_there_is_one_line(name: str) -> None:
    attempt, words = ABSENT[name]
    with pytest.raises(AttributeError, match=words) as caught:
        attempt()
    assert "\n" not in str(caught.value)


def test_an_error_within_a_property_stays_its_own() -> None:
    class Broken(Explained):
        @property
        def size(self) -> int:
            return self.missing  # type: ignore[attr-defined, no-any-return]

        other = 1

    with pytest.raises(AttributeError, match=r"^'Broken' object has no attribute 'missing'; known: other, size$"):
        Broken().size  # noqa: B018
    assert not hasattr(Broken(), "_hidden") and copy.deepcopy(Broken()).other == 1


def test_rendering_without_a_picture_names_the_cause() -> None:
    env = coopenv.parallel_env(ENV)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert env.render() is None
    with pytest.raises(coopenv.CoopenvError, match=r"^render\(\) called before reset\(\)$"):
        coopenv.parallel_env(ENV, render_mode="rgb_array").render()


def test_the_state_before_a_reset_is_refused() -> None:
    for env in (coopenv.parallel_env(ENV), coopenv.make_vec(ENV, num_worlds=2)):
        with pytest.raises(coopenv.CoopenvError, match=r"^state\(\) called before reset\(\)$"):
            env.state()
        env.reset(seed=0)
        assert env.state().any()


def test_classes_and_functions_are_agents() -> None:
    class Straight:
        def __init__(self, scenario: Scenario) -> None:
            assert scenario.driven

        def __call__(self, observations: np.ndarray) -> np.ndarray:
            return np.zeros((len(observations), 2))

    def still(observations: np.ndarray) -> np.ndarray:
        return np.zeros((len(observations), 2))

    class Model:  # as of Stable-Baselines3
        def predict(self, observations: np.ndarray, deterministic: bool = False) -> tuple[np.ndarray, None]:
            assert deterministic
            return still(observations), None

    found = coopenv.evaluate(ENV, [Straight, still, Model()], worlds=2, overrides={"horizon": 1.0})
    assert [*found.episodes] == ["Straight", "still", "Model"]
    first, *others = found.episodes.values()
    for other in others:
        np.testing.assert_array_equal(first.position, other.position)


def test_groups_print_their_help_and_options_are_no_commands(capsys: pytest.CaptureFixture[str]) -> None:
    for group in ("bench", "svea"):
        assert main([group]) == 0 and f"{group} [OPTIONS] COMMAND" in capsys.readouterr().out
    assert "no such command: 'version' (did you mean '--version'?)" in refused("version")
    assert "; an environment runs with: coopenv run facade" in refused("facade")


def test_the_shell_compares_under_the_name_of_python(capsys: pytest.CaptureFixture[str]) -> None:
    short = ["--override", "horizon=0.3", "--seeds", "1", "--jobs", "1", "--json"]
    assert main(["compare", ENV, "--observers", "dead_reckoning", *short]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["observer"] == "dead_reckoning"


def test_results_and_scenarios_are_compared_and_hashed(scenario: Scenario) -> None:
    """Results by identity, because equality of their arrays has no single truth value; scenarios by value."""
    run = coopenv.run(scenario, seed=0)
    results = [run, run.trajectory, coopenv.compare(["dead_reckoning"], scenario, seeds=1)]
    results.append(coopenv.evaluate(scenario, ["peek"], worlds=2))
    for result in results:
        assert result == result and result != pickle.loads(pickle.dumps(result))
        assert {result: 1}[result] == 1
    assert {scenario: 1}[copy.deepcopy(scenario)] == 1
    assert scenario != scenario | {"horizon": 1}
