"""Pages of the reference that are made from the project when the site is built."""

import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping

from coopenv.base.installation import list_agents, list_envs
from coopenv.observers.registry import zoo
from sitegen.mirror import ROOT, examples_page, page_of, relinked
from sitegen.observers import observers

LISTED: dict[str, Callable[[], list[dict[str, str]]]] = {
    "environments/README.md": lambda: [{name: f"environments/{name}.md"} for name in list_envs()],
    "reference/observers/index.md": lambda: [{name: f"reference/observers/{name}_.md"} for name in sorted(zoo())],
    "reference/agents/index.md": lambda: [{name: page_of(f"agents/{name}/card.md")} for name in list_agents()],
}
"""Pages that the navigation lists below another one."""


def generated() -> Iterator[tuple[str, str]]:
    """Yield path and Markdown text of every page."""
    yield "reference/command_line.md", command_line()
    yield "gallery.md", gallery()
    yield "files/examples.md", examples_page()
    yield from observers()
    for file, page in mirrored().items():
        yield page, relinked((ROOT / file).read_text(encoding="utf-8"), file, page)


def gallery() -> str:
    """Return the page with the film of every environment, or its picture, which leads to its page."""
    cards, in_3d = [], [name for name in list_envs() if (ROOT / f"docs/environments/{name}_3d.webp").is_file()]
    for name in [*in_3d, *(name for name in list_envs() if name not in in_3d)]:  # pictures of one height side by side
        page = ROOT / "docs/environments" / name
        title = page.with_suffix(".md").read_text(encoding="utf-8").partition("\n")[0].strip("# ")
        [picture, *_] = [
            file for end in ("_3d.webp", ".webp", ".png") if (page.parent / (file := f"{name}{end}")).is_file()
        ]
        cards.append(f"[![{title}](environments/{picture}){{ loading=lazy }} {title}](environments/{name}.md)")
    return "\n\n".join(["# Gallery", '<div class="gallery" markdown>', *cards, "</div>"]) + "\n"


def mirrored() -> dict[str, str]:
    """Return which files of the repository are pages as they are, and which."""
    files = ["CHANGELOG.md", "CODE_OF_CONDUCT.md", "CONTRIBUTING.md", "SECURITY.md", "agents/README.md"]
    cards = sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("agents/*/card.md"))
    return {file: page_of(file) for file in [*files, *cards]}


def command_line() -> str:
    """Return the page of the command line, as typer describes it."""
    command = [sys.executable, "-m", "typer", "coopenv.cli.app", "utils", "docs", "--name", "coopenv"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    text = done.stdout.replace("# `coopenv`\n", "# Command line\n", 1)
    text = text.replace("**Usage**:\n\n```console\n$ ", "```console\n$ ")
    about = dict(re.findall(r"^##+ `coopenv ([^`]+)`\n\n(.+)$", text, re.MULTILINE))
    return "\n\n## ".join(_listed_whole(part, about) for part in text.split("\n\n## "))


def _listed_whole(part: str, about: Mapping[str, str]) -> str:
    """Return a command's part of the page with whole sentences in its list of commands, which typer shortens."""
    found = re.match(r"`coopenv (.+)`\n", part)
    group = f"{found[1]} " if found else ""

    def row(match: re.Match[str]) -> str:
        return f"* `{match[1]}`: {about.get(group + match[1], match[2])}"

    return re.sub(r"^\* `([a-z0-9-]+)`: (.+)$", row, part, flags=re.MULTILINE)
