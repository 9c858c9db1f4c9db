"""The pages of environments say what the files say, and those of the project are up to date."""

from __future__ import annotations

import json
from importlib.util import find_spec
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from coopenv.base.installation import list_envs
from coopenv.bench.cards import OVERVIEW
from coopenv.scenario import Scenario, load_scenario
from coopenv.viz.topview_ground import HEIGHT, WIDTH
from sitegen.environments.__main__ import main
from sitegen.environments.page import environment_page, index_text
from sitegen.environments.sensing import (
    DRIVERS,
    SETTINGS,
    fingerprint,
    measured_drivers,
    studied,
    value_of_sensing_text,
)
from tests.helpers.commands import refused

PAGES = Path(__file__).parents[2] / "docs" / "environments"
SMALL = """
title = "A | b"
description = "One <car>."
horizon = 2.0
landmarks = [{ name = "sign", position = [1, 2, 3], presence = 0.75 }]
landmark_groups = [{ name = "posts", count = 3, boxes = [{ center = [5, 5], half = [2, 1] }], height = [0.4, 1.2] }]
vehicles = [{ initial_pose = { position = [0, 0, 0], yaw_spread = 0.1 }, motion = { kind = "driven" } }]
randomisation = { camera_range = [0.75, 1.25] }
difficulty = { v2x_loss = [0.0, 2.0] }
reward.weights = { time = 0.375 }
camera.range = 7.25
"""


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


@pytest.mark.parametrize("name", list_envs())
def test_the_page_of_every_environment_is_up_to_date(name: str) -> None:
    page, measure = PAGES / f"{name}.md", " --measure" if measured_drivers(name) else ""
    again = f"run: python -m sitegen.environments {name} --out docs/environments"
    assert page.is_file(), again + measure
    assert page.read_text(encoding="utf-8") == environment_page(name, load_scenario(name), PAGES), again
    assert not measure or (PAGES / f"{name}.json").is_file(), again + measure
    with Image.open(PAGES / f"{name}.png") as picture:
        assert picture.size == (WIDTH, HEIGHT), again
    for film in (f"{name}.webp", *([f"{name}_3d.webp"] if load_scenario(name).driven else [])):
        assert f"]({film})" in page.read_text(encoding="utf-8"), again
        with Image.open(PAGES / film) as pictures:
            assert pictures.n_frames > 20, again


def test_actions_are_described_for_a_vehicle_that_is_driven() -> None:
    page = environment_page("behind_truck", load_scenario("behind_truck"), PAGES)  # vehicle_1 is the truck
    assert "for `vehicle_2`, the first driven vehicle" in page and "| speed | 0 | 0.9 | m/s |" in page


def test_columns_with_nothing_in_them_are_left_out() -> None:
    heads = {
        name: environment_page(name, load_scenario(name), PAGES).partition("## Routes (m)\n\n")[2].partition("\n")[0]
        for name in ("svea_crossing", "behind_truck")
    }
    assert heads == {
        "svea_crossing": "| route | waypoints | corners |",
        "behind_truck": "| route | waypoints | corners | drawn |",
    }


def test_the_index_lists_every_environment() -> None:
    index = (PAGES / "README.md").read_text(encoding="utf-8")
    assert index == index_text({name: load_scenario(name) for name in list_envs()}), "run: make pages"
    assert index.count("](") == len(list_envs())


def test_a_page_says_what_the_file_says(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(small), "--out", str(tmp_path / "pages")]) == 0
    assert "small.md" in capsys.readouterr().out
    made = {"small.md", "small.png", "small.webp"} | ({"small_3d.webp"} if find_spec("pyvista") else set())
    assert {path.name for path in (tmp_path / "pages").iterdir()} == made
    text = (tmp_path / "pages" / "small.md").read_text(encoding="utf-8")
    for line in (
        *("# A | b", "One &lt;car>.", "- whether a landmark is there: with 75 %", "| `time` | 0.375 | s |"),
        *("- the places of 3 landmarks `posts`, over one area", "- a factor of the cameras' range: 0.75 to 1.25"),
        *("0 at difficulty 0, 2 at 1", "| posts | 3 | (5, 5) +- (2, 1) | 0.4 to 1.2 |", "| `camera.range` | 7.25 |"),
        *("- a vehicle's heading: +- 5.73 deg", "| steering | -0.6981 | 0.6981 | rad |", "after 2 s, 20 decisions"),
    ):
        assert line in text, line
    assert "| posts_1 |" not in text
    assert "What sensing is worth" not in text
    for line in text.splitlines():
        if line.startswith("|"):
            assert line.endswith("|")
    with Image.open(tmp_path / "pages" / "small.png") as picture:
        assert np.ptp(np.asarray(picture.convert("L"))) > 100


def test_what_moves_has_a_film(tmp_path: Path) -> None:
    """Where nothing moves there is none, and one of earlier is no longer there."""
    moving, still = tmp_path / "moving.toml", tmp_path / "still.toml"
    for path, motion in ((moving, 'kind = "constant", linear = [1, 0, 0]'), (still, 'kind = "static"')):
        path.write_text(
            'title = "Straight on"\nhorizon = 2.0\nobserver.name = "riccati"\n'
            'landmarks = [{ name = "sign", position = [1, 2, 3] }]\n'
            f"[[vehicles]]\ninitial_pose = {{ position = [0, 0, 0] }}\nmotion = {{ {motion} }}\n"
        )
    out = tmp_path / "pages"
    out.mkdir()
    (out / "still.webp").write_bytes(b"earlier")
    assert main([str(moving), str(still), "--out", str(out)]) == 0
    assert sorted(path.name for path in out.glob("*.webp")) == ["moving.webp"]
    with Image.open(out / "moving.webp") as film:
        assert film.n_frames == 13  # 2 s at 6 pictures a second, and the first
    text = (out / "moving.md").read_text(encoding="utf-8")
    assert "](moving.webp)" in text and "estimated by `riccati`" in text and "driven by" not in text
    assert ".webp" not in (out / "still.md").read_text(encoding="utf-8")
    before = (out / "moving.webp").stat().st_mtime_ns
    assert main([str(moving), "--no-film", "--out", str(out)]) == 0
    assert (out / "moving.webp").stat().st_mtime_ns == before
    assert "](moving.webp)" in (out / "moving.md").read_text(encoding="utf-8")


def test_the_dial_is_measured_and_shown(tmp_path: Path) -> None:
    assert main(["facade", "--measure", "--worlds", "2", "--no-film", "--out", str(tmp_path)]) == 0
    value = json.loads((tmp_path / "facade.json").read_text())
    assert {(row["sensing"], row["agent"]) for row in value["rows"]} == {
        (how, who) for how in SETTINGS for who in DRIVERS
    }
    e95 = {(row["sensing"], row["agent"]): row["mean"] for row in value["rows"] if row["metric"] == "e95_m"}
    assert e95["ideal", "route_follower"] < e95["blind", "route_follower"]
    text = (tmp_path / "facade.md").read_text()
    assert f"{100 * e95['blind', 'peek']:.0f} [" in text.split("| blind | peek |")[1]
    assert (tmp_path / "README.md").read_text().count("](") == 1


def made_up_value_of_sensing(scenario: Scenario) -> dict[str, object]:
    rows = [
        {"sensing": how, "agent": who, "metric": metric, "mean": 0.5, "ci_low": 0.25, "ci_high": 0.75, "n": 2}
        for how, who, metric in product(SETTINGS, DRIVERS, OVERVIEW)
    ]
    return {"coopenv": "1.2.3", "worlds": 2, "score": 2, "scenario": fingerprint(scenario), "rows": rows}


def test_figures_of_cooperation_stand_where_several_vehicles_drive() -> None:
    for name, several in (("open_square", True), ("behind_truck", False)):  # the truck is traffic
        scenario = load_scenario(name)
        assert ({"cars unseen", "radio off"} <= {*studied(name, scenario)[1]}) == several
        page = (PAGES / f"{name}.md").read_text(encoding="utf-8")
        assert ("## What sensing and cooperation are worth" in page) == ("| radio off | peek |" in page) == several


def test_figures_that_are_older_than_the_environment_are_marked() -> None:
    value = made_up_value_of_sensing(load_scenario("facade"))
    for changes, marked in (({}, False), ({"title": "Another"}, False), ({"camera.range": 5.0}, True)):
        text = value_of_sensing_text("facade", load_scenario("facade", changes), value)
        assert ("has changed since" in text) == marked and "| sensed | peek | 50 [25, 75] |" in text
    assert "has changed since" in value_of_sensing_text("facade", load_scenario("facade"), value | {"score": 1})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "name environments, or give --all"),
        (["facade", "--all"], "name environments, or give --all"),
        (["facad"], "did you mean 'facade'"),
        (["facade", "envs/facade.toml"], "two environments have the same name"),
        (["busy_intersection", "--measure"], "all motion here is prescribed"),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], words: str, tmp_path: Path) -> None:
    assert words in refused(*arguments, "--out", str(tmp_path / "pages"), command=main)
    assert not list(tmp_path.rglob("*.*"))


def test_figures_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    (tmp_path / "facade.json").write_text('{"rows": []}')
    assert "facade.json: no figures of a page" in refused("facade", "--out", str(tmp_path), command=main)
    assert [path.name for path in tmp_path.iterdir()] == ["facade.json"]
