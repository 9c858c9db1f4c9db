"""Pages made from the project, links, and tutorials that run from top to bottom as they stand."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from coopenv.base.installation import list_agents, list_envs
from coopenv.cars.fake.settings import FakeSettings
from coopenv.cars.link.transport import Tls
from coopenv.cars.settings.deployment import (
    Car,
    Deployment,
    GateLink,
    NetworkSettings,
    Remote,
    Safety,
    Security,
    Sensors,
)
from coopenv.cars.settings.profile import SVEA
from coopenv.cars.settings.sensors import Correction
from coopenv.observers import registry
from coopenv.observers.registry import zoo
from coopenv.scenario.terms import OBSERVATION_FIELDS, REWARD_TERMS
from coopenv.viz import FIGURE_NAMES
from sitegen import mirror, pages, reference
from tests.helpers.sessions import ROOT, blocks, compare, run_page

LINK = re.compile(r"\]\(([^)]+)\)")


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    return dict(pages.generated())


def test_there_is_a_page_of_every_observer_agent_and_environment(made: dict[str, str]) -> None:
    assert {f"reference/observers/{name}_.md" for name in zoo()} <= made.keys()
    assert {f"reference/agents/{name}.md" for name in list_agents()} <= made.keys()
    assert all((ROOT / "docs" / "environments" / f"{name}.md").is_file() for name in list_envs())
    gallery = made["gallery.md"]
    assert all(f"(environments/{name}.md)" in gallery for name in list_envs())
    assert all((ROOT / "docs" / film).is_file() for film in re.findall(r"!\[[^]]*\]\(([^)]+)\)", gallery))
    listed = [next(iter(row.values())) for rows in pages.LISTED.values() for row in rows()]
    assert len(listed) == len(zoo()) + len(list_agents()) + len(list_envs())
    assert {page for page in listed if page.startswith("reference/")} <= made.keys()


def test_pages_of_observers_say_where_they_come_from(made: dict[str, str]) -> None:
    for name, entry in zoo().items():
        page = made[f"reference/observers/{name}_.md"]
        place, _, item = entry.plugin.partition(":")
        assert f"::: {entry.package}.{place}.{item}" in page and "## Method and source" in page
        assert "<" not in page.partition("## Method and source")[2]  # Markdown's escape of it is none
        assert ("inside the kernels" in page) == bool(entry.kernels)
    assert "Runs in kernels on the CPU that the host calls" in made["reference/observers/hamel_samson_.md"]
    assert "Runs in Python on the host." in made["reference/observers/mekf_.md"]


def test_the_site_has_every_table_of_the_reference() -> None:
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "reference").glob("*.md")]
    named = [name for text in texts for name in re.findall(r"<!-- table: (\w+) -->", text)]
    assert sorted(named) == sorted(reference.TABLES)
    made = "".join(reference.filled(text) for text in texts)
    assert "<!-- table" not in made and "The site (`make docs`)" not in made
    assert all(table() in made for table in reference.TABLES.values())


def test_the_page_on_observations_explains_every_entry() -> None:
    page = reference.observation()
    assert (
        "| targets | number of targets | 0 | vehicle |" in page and "| rad | value at action 1 | 0 | vehicle |" in page
    )
    assert not re.search(r"\| (targets|steering|turn_rate|pan) \| 0 \| vehicle \|", page)
    assert all(
        f"| `{name}` | {field.meaning} | {field.unit} |" in page for name, field in OBSERVATION_FIELDS.built_in.items()
    )
    assert all(f"| `{name}` |" in page and f"| {term.unit} |" in page for name, term in REWARD_TERMS.built_in.items())
    assert all(f"(../environments/{name}.md#observation)" in page for name in list_envs())


def test_the_page_on_deployment_files_has_every_key() -> None:
    page = reference.TABLES["deployment"]()
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    found = {row.split("`")[1]: [cell.strip() for cell in row.split("|")[2:5]] for row in rows}
    parts = {"": Deployment, "cars.": Car, "network.": NetworkSettings, "network.tls.": Tls}
    parts |= {"gate.": GateLink, "sensors.": Sensors, "safety.": Safety, "remote.": Remote, "security.": Security}
    parts |= {"fake.": FakeSettings, "sensors.corrections.": Correction}
    sections = {part.partition(".")[0] for part in parts if part} - {"cars"}
    wanted = {f"{prefix}{name}" for prefix, part in parts.items() for name in part.model_fields} - sections - {"file"}
    assert found.keys() == wanted and all(meaning for _, _, meaning in found.values())
    assert found["safety.max_speed"][:2] == ["0.5", "above 0"]
    assert found["network.connect"][0] == "`tcp/127.0.0.1:7447`" and found["cars.name"][0] == "required"


def test_the_page_on_topics_has_every_topic() -> None:
    assert reference.TOPIC_ROWS.keys() == SVEA.topics.keys()


def test_the_page_of_the_command_line_has_every_command(made: dict[str, str]) -> None:
    page = made["reference/command_line.md"]
    for command in ("run", "bench observers", "svea gate", "import", "train"):
        assert f"`coopenv {command}`\n" in page
    assert "--observers" in page
    lists = re.findall(r"^\* `[a-z-]+`: (.+)$", page, re.MULTILINE)
    assert len(lists) > 20 and not [line for line in lists if line.endswith("...")]


def test_no_two_pages_have_the_same_title(made: dict[str, str]) -> None:
    """A search lists them by their titles."""
    texts = [text for page, text in made.items() if not page.startswith("files/")]
    texts += [path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md")]
    titles = [text.partition("\n")[0] for text in texts]
    assert not {title for title in titles if titles.count(title) > 1}


def test_links_into_the_repository_become_pages() -> None:
    text = "[a](../envs/facade.toml) [b](method.md#x) [c](https://mcap.dev) [d](#here)\n"
    text += "```\n[e](../envs/facade.toml)\n```\n"
    assert list(mirror.links(text, "docs/page.md")) == ["envs/facade.toml", "docs/method.md"]
    changed = mirror.relinked(text, "docs/page.md", "page.md")
    assert changed.splitlines()[0] == "[a](files/envs/facade.toml.md) [b](method.md#x) [c](https://mcap.dev) [d](#here)"
    assert "[e](../envs/facade.toml)" in changed
    assert mirror.relinked("[x](peek/card.md)\n", "agents/README.md", "reference/agents/index.md") == "[x](peek.md)\n"
    with pytest.raises(ValueError, match=r"envs/none\.toml is not in the repository"):
        mirror.relinked("[x](../envs/none.toml)", "docs/page.md", "page.md")


DOCS = Path(__file__).parents[2] / "docs"
PAGES = {
    "tutorials/first_steps.md": [],
    "tutorials/own_observer.md": [pytest.mark.slow],
    "tutorials/ranges.md": [pytest.mark.slow],
    "tutorials/train.md": [pytest.mark.train, pytest.mark.slow],
    "tutorials/logs.md": [pytest.mark.slow],
    "tutorials/cars.md": [pytest.mark.slow],
    "how-to/scenario.md": [pytest.mark.slow],
    "how-to/figures.md": [pytest.mark.slow],
    "how-to/faults.md": [pytest.mark.slow],
    "how-to/batches.md": [],
    "contributing/sensor.md": [pytest.mark.slow],
    "contributing/vehicle.md": [pytest.mark.slow],
}


def test_every_page_with_programs_is_run() -> None:
    folders = [DOCS / folder for folder in ("tutorials", "how-to", "contributing")]
    pages = {
        path.relative_to(DOCS).as_posix() for folder in folders for path in folder.glob("*.md") if any(blocks(path))
    }
    assert pages == PAGES.keys()


CHAIN = ("mekf_covariance", "schmidt_kalman")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(registry, "_registered", {})
    monkeypatch.setattr(registry, "_places", {})
    return tmp_path


@pytest.mark.parametrize("page", [pytest.param(page, marks=marks, id=page) for page, marks in PAGES.items()])
def test_the_page_runs(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = run_page(DOCS / page, folder, monkeypatch)
    if page == "tutorials/first_steps.md":
        assert (folder / "lost.png").stat().st_size > 20_000
        error = [info["position_error"] for info in program["infos"].values()]
        assert max(error[:4]) < 0.2 < error[4]  # as the page says
        assert 0.3 < error[4] / program["infos"]["vehicle_5"]["position_std"] < 3.0
    elif page == "tutorials/own_observer.md":
        rows = program["found"].rows
        mean = {
            name: np.mean([r.position_rmse_m for r in rows if r.observer == name])
            for name in program["found"].observers
        }
        assert mean["robust"] < mean["Mine"] < mean["riccati"] < mean["dead_reckoning"]
        naive, mended = (np.array([row.anees for row in program["found"][name].rows]) for name in CHAIN)
        assert (naive[1:4] > mended[1:4]).all() and mended[:4].max() < 1.5 < 3.0 < naive[3]  # as the page says
        assert max(row.worst_after_start_m for row in program["found"]["Mine"].rows) < 3.0
        assert {"errors.png", "out"} <= {path.name for path in folder.iterdir()}
    elif page == "how-to/figures.md":
        drawn = {"figures": "pdf", "out/paper": "pdf", "out/springer": "svg"}
        for where, suffix in drawn.items():
            assert {path.name for path in (folder / where).glob(f"*.{suffix}")} == {
                f"{n}.{suffix}" for n in FIGURE_NAMES
            }
        assert len(list((folder / "out" / "paper" / "tum").iterdir())) == 10
        for name in ("errors.svg", "mine.pdf", "errors.tex", "errors.pdf", "rows.csv"):
            assert (folder / name).stat().st_size > 400
    elif page == "tutorials/train.md":
        assert program["infos"]["vehicle_1"]["outcome"] == "arrived" and program["worst"] < 0.5
    elif page == "tutorials/logs.md":
        assert program["env"].possible_agents == ["vehicle_1", "vehicle_2"]


def test_outputs_are_compared() -> None:
    compare("a: 1.02 m\n", "a: 1.0 m\n")
    for other in ("a: 1.3 m\n", "b: 1.0 m\n", "a: 1.0 m\nb\n"):
        with pytest.raises(AssertionError):
            compare(other, "a: 1.0 m\n")
