"""Tutorials as notebooks, from the same Markdown: `python -m sitegen.notebooks` (`make notebooks`)."""

import re
from pathlib import Path, PurePosixPath

import jupytext
import nbformat

from sitegen.mirror import ROOT, outside_of_fences

TUTORIALS = "docs/tutorials"
FOLDER = ROOT / "examples" / "notebooks"
INSTALL = """```python
import importlib.util
import os

if os.path.isdir("../../examples/notebooks"):  # opened in a clone, whose files are named from its root
    os.chdir("../..")
if importlib.util.find_spec("coopenv") is None:  # on a machine such as Colab's; a path of a wheel can replace the name
    %pip install --quiet "coopenv{extras}"
```"""
EXTRA = re.compile(r"pip install '\.\[([\w,]+)\]'")
FENCE = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', re.DOTALL | re.MULTILINE)
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?:)[^)]+\)")
PICTURE = re.compile(r"^!\[([^\]]*)\]\([^)]+\).*$")


def is_tutorial(uri: str) -> bool:
    """Return whether a page of docs/ is a tutorial that runs."""
    return uri.startswith("tutorials/") and uri.endswith(".md") and uri != "tutorials/index.md"


def name_of(uri: str) -> str:
    """Return the notebook of a tutorial."""
    return str(PurePosixPath(uri).with_suffix(".ipynb"))


def notebook(markdown: str) -> str:
    """Return the notebook of a tutorial: its programs and commands are cells, files that it shows are written.

    Outputs that the page shows are left out, as the notebook makes its own, and so are links, which lead elsewhere.
    The first cell installs coopenv where it is missing, with the extras that the page names. In a clone it goes to the
    root, from which pages name files.
    """

    def cell(match: re.Match[str]) -> str:
        language, file, code = match.groups()
        if file:
            return f"```python\n%%writefile {file}\n{code}```"
        if language == "bash":
            return f"```python\n%%bash\n{code}```"
        return "" if language == "text" else match[0]

    extras = ",".join(dict.fromkeys(EXTRA.findall(markdown)))
    install = INSTALL.format(extras=f"[{extras}]" if extras else "")
    title, _, rest = FENCE.sub(cell, markdown).partition("\n")
    page = f"{title}\n\n{install}\n{rest}"
    text = outside_of_fences(page, lambda line: PICTURE.sub(r"*\1*", LINK.sub(r"\1", line)))
    made = jupytext.reads(text, fmt="md")
    made.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    for number, part in enumerate(made.cells):
        part["id"] = f"cell-{number}"
    return str(nbformat.writes(made)) + "\n"


def write(folder: Path = FOLDER) -> list[Path]:
    """Write the notebooks of all tutorials and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for page in sorted((ROOT / TUTORIALS).glob("*.md")):
        if is_tutorial(f"tutorials/{page.name}"):
            written.append(folder / f"{page.stem}.ipynb")
            written[-1].write_text(notebook(page.read_text(encoding="utf-8")), encoding="utf-8")
    return written


if __name__ == "__main__":
    print(*write(), sep="\n")
