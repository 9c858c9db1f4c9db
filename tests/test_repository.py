"""Files for a host of repositories and its users, and the contents of wheel and source distribution."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from sitegen import mirror, release_notes

ROOT = Path(__file__).resolve().parents[1]
GITHUB = ROOT / ".github"
WORKFLOWS = sorted((GITHUB / "workflows").glob("*.yml"))
SCHEMAS = {
    "vendor.citation-file-format": [ROOT / "CITATION.cff"],
    "vendor.github-workflows": WORKFLOWS,
    "vendor.github-issue-forms": [p for p in sorted((GITHUB / "ISSUE_TEMPLATE").glob("*.yml")) if p.stem != "config"],
    "vendor.github-issue-config": [GITHUB / "ISSUE_TEMPLATE" / "config.yml"],
}


def read(path: Path) -> Any:
    return YAML(typ="safe").load(path.read_text(encoding="utf-8"))


def project() -> dict[str, Any]:
    data: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return data


@pytest.mark.parametrize("schema", SCHEMAS)
def test_files_fit_their_schemas(schema: str) -> None:
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", schema, *map(str, SCHEMAS[schema])]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


def test_citation_and_changelog_are_of_this_version() -> None:
    citation = read(ROOT / "CITATION.cff")
    text = (ROOT / "docs" / "contributing" / "cite.md").read_text(encoding="utf-8")
    assert citation["version"] == project()["version"]
    assert f"\n## {project()['version']} " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"version = {{{project()['version']}}}" in text and citation["title"] in text
    for paper in citation["references"]:
        assert all(
            f"{author['family-names'].replace('å', '{' + chr(92) + 'aa}')}, " in text for author in paper["authors"]
        )


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_call_existing_targets(path: Path) -> None:
    targets = set(re.findall(r"^([\w./$()-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    targets = {target.replace("$(VENV)", ".venv") for target in targets}
    steps = [step for job in read(path)["jobs"].values() for step in job["steps"]]
    commands = "\n".join(step.get("run", "") for step in steps)
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", step["uses"]) for step in steps if "uses" in step)
    assert set(re.findall(r"\bmake ([\w./-]+)", commands)) <= targets
    for module in re.findall(r"python -m (sitegen[\w.]*)", commands):
        assert (ROOT / f"{module.replace('.', '/')}.py").is_file()
    for name in re.findall(r"pytest ([\w./]+)", commands):
        assert (ROOT / name).exists()


def test_the_pythons_that_are_promised_are_tested() -> None:
    versions = read(GITHUB / "workflows" / "tests.yml")["jobs"]["quick"]["strategy"]["matrix"]["python"]
    promised = [row.rpartition(" ")[2] for row in project()["classifiers"] if re.search(r":: Python :: \d\.\d+$", row)]
    assert versions == promised and project()["requires-python"] == f">={versions[0]}"


def test_containers_are_of_files_that_exist() -> None:
    container = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text(encoding="utf-8"))
    assert (ROOT / ".devcontainer" / container["build"]["dockerfile"]).is_file()
    extras = project()["optional-dependencies"].keys()
    for path in (ROOT / "docker").glob("*.Dockerfile"):
        text = path.read_text(encoding="utf-8")
        assert text.count(f"-f docker/{path.name}") >= 1
        for names in re.findall(r"/src\[([\w,]+)\]", text):
            assert set(names.split(",")) <= extras


def test_a_clone_has_small_samples() -> None:
    sizes = {p: p.stat().st_size for p in (ROOT / "examples").rglob("*") if p.is_file() and p.suffix != ".pyc"}
    assert any(path.suffix == ".mcap" for path in sizes) and sum(sizes.values()) < 3_000_000


def test_links_of_the_pages_at_the_top_lead_somewhere() -> None:
    for path in [*ROOT.glob("*.md"), *ROOT.glob("agents/*.md")]:
        home = path.relative_to(ROOT).as_posix()
        for target in mirror.links(path.read_text(encoding="utf-8"), home):
            assert (ROOT / target).exists(), f"{home}: {target}"


def test_release_notes_are_those_of_the_changelog(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(release_notes, "ROOT", tmp_path)
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "1.2.0"\n')
    (tmp_path / "CITATION.cff").write_text("version: 1.2.0\n")
    changelog = tmp_path / "CHANGELOG.md"
    changelog.write_text("# Changelog\n\n## 1.2.0 (2027-01-05)\n\n- New.\n\n## 1.1.0\n\n- Old.\n")
    assert release_notes.notes("v1.2.0") == "- New.\n"
    with pytest.raises(ValueError, match="expected the same version"):
        release_notes.notes("v1.1.0")
    changelog.write_text("# Changelog\n\n## 1.2.0 (unreleased)\n\n- New.\n")
    with pytest.raises(ValueError, match="put the date there"):
        release_notes.notes("v1.2.0")
    changelog.write_text("# Changelog\n")
    with pytest.raises(ValueError, match=r"no section for 1\.2\.0"):
        release_notes.notes("v1.2.0")


HEAVY = {"torch", "ray", "highway-env", "stable-baselines3", "jax"}


def run(*command: str | Path, cwd: Path) -> str:
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    result = subprocess.run([str(c) for c in command], cwd=cwd, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", out, ROOT, cwd=out)
    (built,) = out.glob("*.whl")
    return built


@pytest.mark.packaging
def test_wheel_contents(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    shipped = {Path(n).name for n in names if n.startswith("coopenv/data/envs/")}
    assert shipped == {path.name for path in (ROOT / "envs").iterdir()}
    agents = {Path(n).parts[3] for n in names if n.startswith("coopenv/data/agents/") and len(Path(n).parts) > 4}
    assert agents == {path.name for path in (ROOT / "agents").iterdir() if path.is_dir()}
    assert {"overtaking.toml", "crossing.toml"} <= {Path(n).name for n in names if "data/examples/fleet/" in n}
    assert {"ros1.bag", "mcap.mcap", "topics.toml"} <= {Path(n).name for n in names if "data/examples/bags/" in n}
    examples = {n.partition("data/examples/")[2] for n in names if "data/examples/" in n}
    assert {"own_observer.py", "trainers/torchrl_env.py"} <= examples and not any("__" in n for n in examples)
    tops = {Path(n).parts[0] for n in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == {"coopenv"}
    assert "coopenv/py.typed" in names


@pytest.mark.packaging
def test_the_source_distribution_is_the_repository(tmp_path: Path) -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("what belongs to the repository is known to git alone")
    run(sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", tmp_path, ROOT, cwd=tmp_path)
    (built,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(built) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    tracked = {name for name in run("git", "ls-files", cwd=ROOT).splitlines() if (ROOT / name).exists()}
    assert tracked - names == set()
    assert {name.partition("/")[0] for name in names - tracked} <= {"PKG-INFO", *(n.partition("/")[0] for n in tracked)}


@pytest.mark.packaging
@pytest.mark.slow
def test_the_commands_of_the_readme_need_no_clone(wheel: Path, tmp_path: Path) -> None:
    """From the wheel's files, in an empty folder; long commands are shortened."""
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "site")}
    empty = tmp_path / "empty"
    empty.mkdir()

    def coopenv(*words: str) -> str:
        command = [sys.executable, "-P", "-m", "coopenv", *words]
        done = subprocess.run(command, cwd=empty, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    coopenv("examples")
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    named = {path.partition(":")[0] for path in re.findall(r"examples/[\w./:]+", text)}
    assert len(named) >= 3 and all((empty / path).exists() for path in named), named
    (bag,) = re.findall(r"^coopenv (run examples/bags[^#\n]*)", text, re.MULTILINE)
    assert "vehicle_1" in coopenv(*bag.split(), "--until", "4")
    (own,) = re.findall(r"^coopenv (bench observers .*own_observer[^#\n]*)", text, re.MULTILINE)
    short = ("--seeds", "1", "--override", "horizon=4", "--steady-from", "2")
    coopenv(*own.split(), *short, "--observers", "examples/own_observer.py:Ekf")
    assert (empty / "out" / "mine").is_dir()


@pytest.mark.packaging
@pytest.mark.slow
def test_installed_wheel_makes_environments(wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt", wheel, cwd=tmp_path)
    listed = run(python, "-m", "pip", "list", "--format=freeze", cwd=tmp_path)
    assert not {line.split("==")[0].lower() for line in listed.splitlines()} & HEAVY
    script = (
        "import coopenv, pathlib, gymnasium;"
        f"assert not pathlib.Path(coopenv.__file__).is_relative_to({str(ROOT)!r});"
        "env = coopenv.parallel_env('busy_intersection'); env.reset(seed=0);"
        "print(*coopenv.list_envs(), len(env.step({a: env.action_space(a).sample() for a in env.agents})))"
    )
    printed = run(python, "-c", script, cwd=tmp_path).split()
    assert printed[:-1] == sorted(path.stem for path in (ROOT / "envs").glob("*.toml"))
    assert printed[-1] == "5"
    assert "busy_intersection" in run(tmp_path / "venv" / "bin" / "coopenv", "list", cwd=tmp_path)
    asked = "from coopenv.base.installation import install_command; print(install_command('log'))"
    assert run(python, "-c", asked, cwd=tmp_path).strip() == "pip install 'coopenv[log]'"
    for where in ([sys.executable], [python, "-P"]):  # a checkout, and what was installed from it, in its folder
        assert run(*where, "-c", asked, cwd=ROOT).strip() == "pip install '.[log]'"


@pytest.mark.packaging
def test_the_wheel_has_a_description_that_an_index_shows(wheel: Path) -> None:
    run(sys.executable, "-m", "twine", "check", "--strict", wheel, cwd=ROOT)


def test_tools_of_a_release_are_those_of_the_tests_and_have_hashes() -> None:
    constraints = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    pinned = dict(re.findall(r"^([\w.-]+)==(\S+)", constraints, re.MULTILINE))
    tools = (ROOT / ".ci" / "release.txt").read_text(encoding="utf-8").replace("\\\n", "").splitlines()
    rows = [row.split() for row in tools if row and not row.startswith("#")]
    assert {name.partition("==")[0] for name, *_ in rows} >= {"build", "hatchling", "uv"}
    for tool, *hashes in rows:
        name, _, version = tool.partition("==")
        assert pinned.get(name.replace("-", "_"), pinned.get(name, version)) == version, name
        assert hashes and all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", text) for text in hashes), name
