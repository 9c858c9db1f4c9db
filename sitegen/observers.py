"""A page for each observer: what it is, where it comes from, what it sends, its class."""

import ast
import re
from collections.abc import Iterator
from pkgutil import resolve_name

from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.registry import ZooEntry, zoo
from coopenv.report.table import bullets, markdown
from sitegen.mirror import ROOT, relinked

TABLE = "docs/observers.md"
MORE = {
    "riccati": "../../method.md",
    "robust": "../../robust.md",
    "self_calibrating": "../../data.md",
}
"""Where the documents explain an observer."""
HEAD = """# Observers

An observer estimates the pose of one vehicle. [Comparing observers](../../observers.md) says how they are judged,
[your own observer](../../tutorials/own_observer.md) how to write one.

"""


def observers() -> Iterator[tuple[str, str]]:
    """Yield path and Markdown text of the pages of all observers, and of the one that lists them."""
    known = _rows()
    rows = [(f"[`{name}`]({name}_.md)", *known[name]) for name in zoo()]
    yield "reference/observers/index.md", HEAD + markdown(("name", "what it is", "sends"), rows) + "\n"
    for name, entry in zoo().items():
        yield f"reference/observers/{name}_.md", _page(name, entry, *known[name])


def _rows() -> dict[str, tuple[str, str]]:
    """Return what the table in docs/observers.md says of every observer: what it is, what it sends."""
    text = relinked((ROOT / TABLE).read_text(encoding="utf-8"), TABLE, "reference/observers/index.md")
    found = re.findall(r"^\| `(\w+)` \| (.+) \| (.+) \|$", text.partition("## The zoo")[2], re.MULTILINE)
    return {name: (about, sends) for name, about, sends in found if name in zoo()}


def _docstring(file: str) -> str:
    return ast.get_docstring(ast.parse((ROOT / file).read_text(encoding="utf-8"))) or ""


def _class(entry: ZooEntry) -> object:
    """Return the class or function of an observer, None for one that needs an extra."""
    return None if entry.needs else resolve_name(f"{entry.package}.{entry.plugin}")


def _where(entry: ZooEntry) -> str:
    """Return the sentence that says where an observer is computed."""
    if entry.kernels:
        return "Runs inside the kernels of a batch, on the CPU and on a GPU."
    made = _class(entry)
    if isinstance(made, type) and issubclass(made, KernelObserver):
        return "Runs in kernels on the CPU that the host calls, a vehicle at a time; not in those of a batch."
    return "Runs in Python on the host."


def _page(name: str, entry: ZooEntry, about: str, sends: str) -> str:
    place, _, item = entry.plugin.partition(":")
    module = f"{entry.package}.{place}".replace(".", "/")
    file = f"{module}.py" if (ROOT / f"{module}.py").exists() else f"{module}/__init__.py"
    facts = [
        f"Sends: {sends}.",
        f"Source: `{file}`.",
        _where(entry),
    ]
    facts += [f"Needs `{entry.needs}`: `pip install '.[bench]'`."] if entry.needs else []
    use = f'import coopenv\n\nenv = coopenv.parallel_env("busy_intersection_tracking", observer="{name}")'
    joint = getattr(_class(entry), "joint", False)
    shown = [] if joint else ["## In an environment", f"```python\n{use}\n```"]
    return (
        "\n\n".join(
            [
                f"# {name}",
                about[0].upper() + about[1:] + ".",
                bullets(facts),
                "## Method and source",
                _docstring(file).replace("*", r"\*").replace("<", "&lt;"),
                *([f"[More]({MORE[name]})."] if name in MORE else []),
                *shown,
                "## Code",
                f"::: {entry.package}.{place}.{item}",
            ]
        )
        + "\n"
    )
