"""Pages for files of the repository that docs/ links to, so that the site is whole without a host."""

import ast
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]

PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing/index.md",
    "CODE_OF_CONDUCT.md": "contributing/code_of_conduct.md",
    "SECURITY.md": "contributing/security.md",
    "agents/README.md": "reference/agents/index.md",
    "docs": "index.md",
    "examples": "files/examples.md",
    "examples/fleet": "files/examples.md",
    "examples/notebooks": "tutorials/index.md",
}
"""Pages of files (and folders) that do not stand under files/."""

LANGUAGES = {".py": "python", ".toml": "toml", ".cff": "yaml", ".yml": "yaml", ".json": "json", ".service": "ini"}
LINK = re.compile(r"(?<=\]\()(?!https?:|mailto:|#|/)([^)#\s]*)(#[^)\s]*)?(?=\))")
FENCE = re.compile(r"^\s*(```+|~~~+)")


def page_of(file: str) -> str:
    """Return where the site shows a file or folder of the repository, both as paths with slashes.

    Raises:
        ValueError: there is no such file.
    """
    if file in PAGES:
        return PAGES[file]
    if file.startswith("docs/"):  # MkDocs says so where there is none
        return file.removeprefix("docs/")
    if not (ROOT / file).exists():
        raise ValueError(f"{file} is not in the repository")
    if match := re.fullmatch(r"agents/(\w+)/card\.md", file):
        return f"reference/agents/{match[1]}.md"
    return f"files/{file}.md"


def outside_of_fences(text: str, change: Callable[[str], str]) -> str:
    """Return a Markdown text whose lines outside of code blocks are changed."""
    lines, fence = [], ""
    for line in text.splitlines():
        mark = FENCE.match(line)
        if mark and (not fence or line.strip() == fence):
            fence = "" if fence else mark[1]
        elif not fence:
            line = change(line)
        lines.append(line)
    return "\n".join(lines) + "\n"


def links(text: str, home: str) -> Iterator[str]:
    """Yield the files of the repository that a text links to which stands in the file `home` there."""

    def note(line: str) -> str:
        found.extend(match[1] for match in LINK.finditer(line) if match[1])
        return line

    found: list[str] = []
    outside_of_fences(text, note)
    for target in found:
        yield normalised(target, home)


def normalised(target: str, home: str) -> str:
    """Return the file of the repository that a link in the file `home` leads to."""
    return os.path.normpath(PurePosixPath(home).parent / target)


def relinked(text: str, home: str, page: str) -> str:
    """Return the text of the repository's file `home` with links that are right on the page `page` of the site."""

    def link(match: re.Match[str]) -> str:
        if not match[1]:
            return match[0]
        target = page_of(normalised(match[1], home))
        return os.path.relpath(target, PurePosixPath(page).parent) + (match[2] or "")

    return outside_of_fences(text, lambda line: LINK.sub(link, line))


def source_page(file: str) -> str:
    """Return the page that shows a file as it stands."""
    path = ROOT / file
    text = path.read_text(encoding="utf-8")
    return f"# {file}\n\n````{LANGUAGES.get(path.suffix, 'text')}\n{text.rstrip()}\n````\n"


def listed(folder: str) -> list[str]:
    """Return the programs and settings in a folder, as paths in the repository."""
    return sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob("*") if path.suffix in LANGUAGES)


def examples_page() -> str:
    """Return the page that lists the examples by what they say of themselves."""
    rows = []
    for file in listed("examples"):
        text = (ROOT / file).read_text(encoding="utf-8")
        about = (ast.get_docstring(ast.parse(text)) or "") if file.endswith(".py") else _title(text)
        rows.append(f"- [{file}]({file}.md): {_first_sentence(about)}")
    return "# Examples\n\nShort programs to run from top to bottom in a clone.\n\n" + "\n".join(rows) + "\n"


def _first_sentence(text: str) -> str:
    sentence = text.partition("\n")[0].partition(". ")[0].rstrip(".")
    return sentence if sentence.endswith(("?", "!")) else f"{sentence}."


def _title(text: str) -> str:
    found = re.search(r'^title = "(.+)"', text, re.MULTILINE)
    return found[1] if found else text.partition("\n")[0].strip("# ")
