"""Rows of the table of other projects: their metadata, their outcome, and the page that states them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.interoperability.__main__ import EXAMPLES, ROOT, Example, main, outcome

ROWS = [Example.of(path) for path in sorted(EXAMPLES.glob("*_example.py"))]
METADATA = """
# /// script
# dependencies = ["coopenv"]
# [tool.coopenv]
# package = "coopenv"
# documentation = "https://example.org"
# needs = ["examples/observe.py"]
# ///
"""


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_an_example_states_what_it_needs_and_has_its_row_on_the_page(row: Example) -> None:
    page = (ROOT / "docs" / "interoperability.md").read_text(encoding="utf-8")
    project = row.title.partition(": ")[0]
    assert f"\n| [{project}]({row.documentation}) | " in page
    assert all((ROOT / needed).is_file() for needed in row.needs)
    assert any(name.startswith("coopenv") for name in row.packages)


@pytest.mark.parametrize(
    ("program", "expected"),
    [
        ("import observe_me\nprint('never')", (False, "ModuleNotFoundError: No module named 'observe_me'")),
        (
            "from pathlib import Path\nassert Path('observe.py').is_file()\nprint('first')\nprint('last')",
            (True, "last"),
        ),
        ("raise SystemExit('not that version')", (False, "not that version")),
    ],
)
def test_the_last_line_is_the_result_or_the_reason(program: str, expected: tuple[bool, str], tmp_path: Path) -> None:
    path = tmp_path / "some_example.py"
    path.write_text(f'"""Some: an example."""\n{METADATA}\n{program}\n')
    assert outcome(Example.of(path), Path(sys.executable), tmp_path) == expected


def test_an_unknown_name_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["torch_rl"])
    assert "unknown: torch_rl; known: benchmarl, " in capsys.readouterr().err
