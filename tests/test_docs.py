"""Programs and tables of single pages run as they stand, and commands are understood, though not run.

Programs of tutorials are in tests/sitegen/test_pages.py.
"""

from __future__ import annotations

import re
import runpy
import shlex
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from gymnasium.utils.play import play

import coopenv
from benchmarks.learning.study import read_study
from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import CoopenvError
from coopenv.cars.bags.topic_map import load_map
from coopenv.cli.app import app
from coopenv.policies import act, load_agent
from coopenv.scenario import load_scenario, parse_scenario
from coopenv.training.settings import Clone, read_settings
from tests.helpers import mrclam_files
from tests.helpers.env_suite import rest_slow

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = {page.name: page for page in (ROOT / "README.md", *sorted(DOCS.glob("*.md")))}
RUN = {"README.md", "agents.md", "backends.md", "data.md", "draws.md", "highway.md"}
RUN |= {"outputs.md", "replay.md", "sumo.md", "terms.md", "trainers.md", "view.md"}
"""Pages whose programs are run below."""


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def run(page: Path, *without: str) -> list[dict[str, Any]]:
    """Run a page's programs, but those that hold one of some words, and return the names of each."""
    programs = []
    for block in python_blocks(page):
        if not any(word in block for word in without):
            programs.append({"__name__": "__main__"})
            exec(compile(block, page.name, "exec"), programs[-1])
    return programs


def tables(page: str) -> list[str]:
    return re.findall(r"^```toml[^\n]*\n(.*?)^```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def test_every_page_with_programs_is_run() -> None:
    assert {name for name, page in PAGES.items() if python_blocks(page)} == RUN


PROGRAMS = {
    "README.md": ("coopenv.compare", None),
    "backends.md": (None, None),
    "draws.md": (None, None),
    "highway.md": (None, "highway_env"),
    "view.md": (None, "viser"),
    "outputs.md": (None, None),
    "replay.md": (None, "foxglove"),
    "sumo.md": (None, "libsumo"),
}
"""Pages whose programs need no files: a word of programs that are left out, and a module that is needed."""


@pytest.mark.parametrize("name", rest_slow([(name,) for name in PROGRAMS], *range(5)))
def test_the_programs_of_a_page_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without, module = PROGRAMS[name]
    if module is not None:
        pytest.importorskip(module, reason=f"needs {module}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("coopenv.viz.figures.FIGURE_NAMES", ())
    assert run(PAGES[name], *(without,) * (without is not None))


def test_the_programs_on_terms_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    program: dict[str, Any] = {}
    for block in python_blocks(DOCS / "terms.md"):
        (tmp_path / "program.py").write_text(block, encoding="utf-8")
        program = runpy.run_path(str(tmp_path / "program.py"))
    assert float(capsys.readouterr().out) < 0.0
    program["envs"].reset(seed=0)
    assert np.isfinite(program["envs"].step(np.zeros(program["envs"].action_space.shape))[1]).all()


def test_the_programs_on_agents_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(DOCS / "agents.md", "class Mine", "utils.play")
    lines = capsys.readouterr().out.splitlines()
    arrivals = [line for line in lines if "'arrival_rate'" in line]
    assert ["peek" in line for line in arrivals] == [False, True]
    (tmp_path / "mine.py").write_text(python_blocks(DOCS / "agents.md")[2], encoding="utf-8")
    scenario = load_scenario("urban_crossing")
    policy = load_agent(f"{tmp_path / 'mine.py'}:Mine", scenario)
    rows = np.zeros((3, observation_layout(scenario).size), dtype=np.float32)
    np.testing.assert_array_equal(policy(rows), [[0.0, 0.0]] * 3)


def test_the_player_on_agents_drives_by_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a key the vehicle stands, and w held down drives ahead."""
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    taken: list[list[float]] = []

    def note(before: object, after: object, action: np.ndarray, *rest: object) -> None:
        taken.append(action.tolist())
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=ord("w")))
        if len(taken) == 3:
            pygame.event.post(pygame.event.Event(pygame.QUIT))

    monkeypatch.setattr("gymnasium.utils.play.play", partial(play, callback=note, fps=1000, seed=0))
    exec(compile(python_blocks(DOCS / "agents.md")[0], "agents.md", "exec"), {})
    assert taken[:2] == [[-1.0, 0.0], [1.0, 0.0]]


@pytest.mark.slow
def test_the_front_page_compares(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (program,) = run(ROOT / "README.md", "parallel_env")
    assert program["found"].observers == ("riccati", "robust", "dead_reckoning")
    assert (tmp_path / "errors.pdf").read_bytes().startswith(b"%PDF")


def test_the_page_on_bags(tmp_path: Path) -> None:
    a_map = tables("tutorials/logs.md")[0]
    for text in (a_map, *(a_map + other for other in tables("bags.md"))):  # tables that a map can have
        (tmp_path / "topics.toml").write_text(text, encoding="utf-8")
        assert load_map(tmp_path / "topics.toml").cars[0].name == "svea7"
    shipped = tomllib.loads((ROOT / "examples" / "bags" / "topics.toml").read_text(encoding="utf-8"))
    assert shipped == tomllib.loads(a_map)


def test_the_page_on_recorded_robots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "recordings").mkdir()
    mrclam_files.write(tmp_path / "recordings", 6, seconds=15.0)
    t = np.arange(100) * 0.05
    yaw = 0.1 * t
    x, y = 3.0 * np.sin(yaw), 3.0 * (1.0 - np.cos(yaw))
    angle = np.arctan2(3.0 - y, 3.0 - x) - yaw
    rows = [f"{a},{b},{c},{d},0.3,0.1,,{e}" for a, b, c, d, e in zip(t, x, y, yaw, angle, strict=True)]
    (tmp_path / "robot.csv").write_text("\n".join(["t,x,y,yaw,v,omega,azimuth_1,azimuth_2", *rows]))
    *_, own = run(DOCS / "data.md")
    rmse = coopenv.compare(["mekf"], own["recording"]).rows[0].position_rmse_m
    assert own["recording"].visible[:, 0].sum(axis=0).tolist() == [0, 100, 0] and rmse < 0.05
    errors = np.array([float(number) for number in re.findall(r"\d\.\d+", capsys.readouterr().out)])
    assert errors.shape == (5,) and (errors < 0.5).all()


def test_the_tables_of_draws() -> None:
    lot = {
        "title": "draws",
        "horizon": 1.0,
        "landmarks": [{"name": "a", "position": [1.0, 1.0, 1.0]}],
        "vehicles": [{"motion": {"kind": "driven"}, "initial_pose": {"position": [0.0, 0.0, 0.0]}}],
    }
    routes, streets, landmarks, factors = (tomllib.loads(text) for text in tables("draws.md"))
    routes["routes"].append({"name": "straight", "waypoints": [[-8.0, -0.5], [8.0, -0.5]]})
    assert parse_scenario(lot | routes, "draws.md").vehicles[0].routes == ("left", "straight")
    city = load_scenario({"title": "city", "horizon": 1.0, **streets})
    assert len(city.vehicles) == 34
    assert len(city.obstacles) == 36
    assert len(parse_scenario(lot | landmarks, "draws.md").landmarks) == 11
    assert parse_scenario(lot | factors, "draws.md").randomisation.camera_range == (0.8, 1.2)


def test_the_tables_of_cosimulators() -> None:
    (sumo,), (highway,) = tables("sumo.md"), tables("highway.md")
    assert {*tomllib.loads(sumo)["sumo"]} <= {*type(load_scenario("sumo_crossing").sumo).model_fields}
    raw = {"title": "highway", "horizon": 1.0, "landmarks": [{"name": "a", "position": [1.0, 1.0, 1.0]}]}
    assert parse_scenario(raw | tomllib.loads(highway), "highway.md").backend == "highway"


def flat(table: dict[str, Any], under: str = "") -> dict[str, Any]:
    """Return the values of nested tables by dotted key."""
    pairs = ((f"{under}{key}", value) for key, value in table.items())
    return {
        k: v
        for key, value in pairs
        for k, v in (flat(value, f"{key}.") if isinstance(value, dict) else {key: value}).items()
    }


def test_the_tables_of_terms() -> None:
    (own,) = (tomllib.loads(text) for text in tables("terms.md"))
    lanes = tomllib.loads((ROOT / "examples" / "lane_keeping" / "lane_keeping.toml").read_text(encoding="utf-8"))
    for table in ("reward", "observation", "termination"):
        assert own[table].items() <= (lanes[table] | own[table]).items()
        assert own[table]["custom"].keys() == lanes[table]["custom"].keys()
    page = (ROOT / "docs" / "terms.md").read_text(encoding="utf-8")
    rows = [tomllib.loads(line.split("`")[1]) for line in page.splitlines() if re.match(r"\| `[^`]* = [^`]*` \|", line)]
    roles = [row for row in rows if {*row} & {"action", "vehicles"} or "own_share" in row.get("reward", {})]
    assert len(roles) == 3
    for row in roles:
        assert load_scenario("scout_platoon", {**flat(row), "reward.team": "mean"})


def test_the_settings_of_training(tmp_path: Path) -> None:
    settings, choices, study = tables("trainers.md")
    path = tmp_path / "train.toml"
    path.write_text(choices, encoding="utf-8")
    letters = read_settings(path)
    assert (
        letters.actions == "choices" and letters.clone and (letters.clone.rounds, letters.clone.smoothing) == (3, 0.25)
    )
    path.write_text(settings, encoding="utf-8")
    said = read_settings(path)
    assert (said.steps, said.ppo.hidden, said.clone) == (500_000, (64, 64), Clone(agent=("peek", "route_follower")))
    assert read_settings(path, environment="facade").ppo.hidden == (128, 128)
    assert read_settings(path, "plain", "facade").scenario == {"observation.planar": False}
    (tmp_path / "study.toml").write_text(study, encoding="utf-8")
    path.write_text("[arms.quality]\n[arms.plain]\n", encoding="utf-8")
    assert len(list(read_study(tmp_path / "study.toml").plans)) == 12


@pytest.mark.train
@pytest.mark.slow
def test_the_page_trains_with_stable_baselines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as one rollout: what the page's two million steps give is in nobody's patience."""
    pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")
    monkeypatch.chdir(tmp_path)
    (train,) = (block for block in python_blocks(DOCS / "trainers.md") if "stable_baselines3" in block)
    assert train.count("2_000_000") == 1
    program: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(train.replace("2_000_000", "16_384"), "trainers.md", "exec"), program)
    (drive,) = re.findall(r"`(lambda rows: model\.predict.*)`", (DOCS / "trainers.md").read_text(encoding="utf-8"))
    env = coopenv.parallel_env("urban_crossing")
    observations, _ = env.reset(seed=5)
    actions = act(eval(drive, program), observations)
    assert all(env.action_space(agent).contains(action) for agent, action in actions.items()) and actions


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "word"),
    [
        pytest.param("ray", "CooperativeRows", marks=pytest.mark.rllib),
        pytest.param("torchrl", "batched_env", marks=pytest.mark.torchrl),
        pytest.param("benchmarl", "benchmarl", marks=pytest.mark.benchmarl),
    ],
)
def test_the_page_trains_with_libraries(
    package: str, word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    extra = {"ray": "rllib"}.get(package, package)
    pytest.importorskip(package, reason=f"needs the extra {extra!r}")
    monkeypatch.chdir(tmp_path)
    (block,) = (block for block in python_blocks(DOCS / "trainers.md") if re.search(rf"^from .*{word}", block, re.M))
    exec(compile(block, "trainers.md", "exec"), {"__name__": "__main__"})
    if package != "benchmarl":
        assert capsys.readouterr().out


COMMAND: Any = typer.main.get_command(app)
ALL_PAGES = [*sorted(ROOT.glob("*.md")), *sorted(ROOT.glob("agents/*.md")), *sorted(ROOT.glob("docs/**/*.md"))]
FENCE = re.compile(r"^ *```(\w*)[^\n]*\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
OTHER_LANGUAGES = {"python", "toml", "text", "bibtex", "json"}
OUTPUT = re.compile(r"coopenv +(\(|\d)")
"""Lines of benchmarks' tables that begin with the project's name."""


def commands(page: Path) -> Iterator[list[str]]:
    """Yield the words after `coopenv` of every command in a page's blocks."""
    for language, body in FENCE.findall(page.read_text(encoding="utf-8")):
        for line in body.replace("\\\n", " ").splitlines() if language not in OTHER_LANGUAGES else ():
            if line.strip().startswith("coopenv ") and not OUTPUT.match(line.strip()):
                yield shlex.split(line, comments=True)[1:]


def understand(words: list[str]) -> None:
    """Read a command's words as the command line does. Raises typer's error where it does not know one."""
    name, command = "coopenv", COMMAND
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        assert words[0] in command.commands, f"no command {words[0]}"
        name, words, command = words[0], words[1:], command.commands[words[0]]
    if words != ["--install-completion"]:  # which is done while words are read
        with suppress(CoopenvError):  # names and files of the reader, such as `my_driver`, are looked up at once
            command.make_context(name, words)


@pytest.mark.parametrize("page", ALL_PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_are_understood(page: Path) -> None:
    for words in commands(page):
        understand(list(words))


def test_commands_are_found() -> None:
    assert sum(1 for page in ALL_PAGES for _ in commands(page)) > 100
