"""What a host of repositories and its users read: citation, forms, workflows, hooks, containers, releases."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
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
def test_workflows_call_what_there_is(path: Path) -> None:
    targets = set(re.findall(r"^([\w./$()-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    targets = {target.replace("$(VENV)", ".venv") for target in targets}
    steps = [step for job in read(path)["jobs"].values() for step in job["steps"]]
    commands = "\n".join(step.get("run", "") for step in steps)
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@v\d+", step["uses"]) for step in steps if "uses" in step)
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


def test_links_of_the_pages_at_the_top_lead_somewhere() -> None:
    for path in [*ROOT.glob("*.md"), *ROOT.glob("agents/*.md")]:
        home = path.relative_to(ROOT).as_posix()
        for target in mirror.links(path.read_text(encoding="utf-8"), home):
            assert (ROOT / target).exists(), f"{home}: {target}"


def test_hooks_find_mistakes(tmp_path: Path) -> None:
    hooks = {hook["id"]: hook for repo in read(ROOT / ".pre-commit-config.yaml")["repos"] for hook in repo["hooks"]}
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    bad = tmp_path / "bad.py"
    bad.write_text("import os\nx  = 1\n", encoding="utf-8")
    for name, status in (("ruff-check", 1), ("ruff-format", 0)):
        entry = hooks[name]["entry"].removeprefix("bash -c '").partition("' --")[0]
        done = subprocess.run(
            ["bash", "-c", entry, "--", str(bad)], cwd=ROOT, env=environment, capture_output=True, text=True
        )
        assert done.returncode == status, done.stdout + done.stderr
    assert bad.read_text(encoding="utf-8") == "import os\n\nx = 1\n"


def test_a_release_says_what_the_changelog_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
