"""The tutorials as notebooks: the same programs, and they run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.helpers.sessions import ROOT, prepare

pytest.importorskip("jupytext", reason="needs the extra 'docs'")
nbformat = pytest.importorskip("nbformat", reason="needs the extra 'docs'")

from sitegen import notebooks  # noqa: E402

NAMES = ("first_steps", "own_observer", "ranges", "train", "logs", "cars")


def cells(text: str) -> list[str]:
    return [cell.source for cell in nbformat.reads(text, as_version=4).cells if cell.cell_type == "code"]


def test_a_page_becomes_cells() -> None:
    page = (
        "# Title\n\nSee [there](x.md) and [out](https://mcap.dev).\n\n![A car](car.png)\n\n"
        '```python title="mine.py"\nx = 1\n```\n\n```bash\nls\n```\n\n```python\nprint(1)\n```\n\n'
        "```text\n1\n```\n\n```\nshown\n```\n"
    )
    text = notebooks.notebook(page)
    install, *others = cells(text)
    assert others == ["%%writefile mine.py\nx = 1", "%%bash\nls", "print(1)"]
    assert '%pip install --quiet "coopenv"' in install
    assert '"coopenv[log,view]"' in cells(notebooks.notebook("# A\n\nIt needs `pip install '.[log,view]'`.\n"))[0]
    prose = "".join(cell.source for cell in nbformat.reads(text, as_version=4).cells if cell.cell_type == "markdown")
    assert "See there and [out](https://mcap.dev)" in prose and "*A car*" in prose and "shown" in prose
    assert json.loads(text)["metadata"]["kernelspec"]["name"] == "python3"
    assert text == notebooks.notebook(page)


def test_every_tutorial_becomes_one_without_outputs_as_in_the_clone(tmp_path: Path) -> None:
    written = notebooks.write(tmp_path)
    assert sorted(path.stem for path in written) == sorted(NAMES)
    for path in written:
        text = path.read_text(encoding="utf-8")
        nbformat.validate(nbformat.reads(text, as_version=4))
        assert len(cells(text)) >= 3 and not any(cell.get("outputs") for cell in json.loads(text)["cells"])
        assert text == (notebooks.FOLDER / path.name).read_text(encoding="utf-8"), "run `make notebooks`"


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.train if n == "train" else ()) for n in NAMES])
def test_notebooks_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbclient = pytest.importorskip("nbclient", reason="needs the extra 'docs'")
    pytest.importorskip("ipykernel", reason="needs the extra 'docs'")
    prepare(name, tmp_path, monkeypatch)
    page = ROOT / "docs" / "tutorials" / f"{name}.md"
    made = nbformat.reads(notebooks.notebook(page.read_text(encoding="utf-8")), as_version=4)
    client = nbclient.NotebookClient(
        made, timeout=600, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    )
    client.execute()  # raises where a cell does
    assert all(cell.execution_count for cell in made.cells if cell.cell_type == "code")
