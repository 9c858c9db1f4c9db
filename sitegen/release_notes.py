"""Notes of a release: `python -m sitegen.release_notes v0.9.0` prints the changelog's section."""

import re
import sys
import tomllib

from sitegen.mirror import ROOT


def notes(tag: str) -> str:
    """Return the section of the changelog that a tag stands for.

    Raises:
        ValueError: the tag is not the version of pyproject.toml and CITATION.cff, or the changelog
            has no such section or calls it unreleased.
    """
    version = tag.removeprefix("v")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    if not version == project == (cited and cited[1]):
        raise ValueError(
            f"tag {tag}, pyproject.toml {project}, CITATION.cff {cited and cited[1]}: expected the same version"
        )
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    section = re.search(rf"^## {re.escape(version)}([^\n]*)\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    if section is None or not section[2].strip():
        raise ValueError(f"CHANGELOG.md: no section for {version}")
    if "unreleased" in section[1]:
        raise ValueError(f"CHANGELOG.md: the heading of {version} says unreleased; put the date there")
    return section[2].strip() + "\n"


if __name__ == "__main__":
    try:
        print(notes(sys.argv[1]), end="")
    except (IndexError, ValueError) as error:
        sys.exit(f"error: {error}")
