"""A table on a terminal, in Markdown, in LaTeX and as CSV."""

from __future__ import annotations

import numpy as np
import pytest

from coopenv.base.format import column
from coopenv.report.table import Column, Table, bullets, markdown
from coopenv.report.terminal import text_of


def lines(table: Table, width: int) -> list[str]:
    """Return the lines of a table on a terminal without rules, a space between the cells."""
    return [" ".join(line.split()) for line in text_of(table, width).splitlines() if "─" not in line]


def test_columns_that_do_not_fit_stand_in_a_further_table() -> None:
    row = ("vehicle_1", "0.1", "4", "0.2")
    table = Table.of_texts(["\nvehicle"], ["start\n[m]", "\n[deg]", "RMSE\n[m]"], [row], folds=True)
    headings = ["start", "vehicle [m] [deg]", "vehicle_1 0.1 4", "RMSE", "vehicle [m]", "vehicle_1 0.2"]
    assert lines(table, 25) == headings
    assert text_of(table, 40).count("vehicle_1") == 1
    assert text_of(table, 20).count("vehicle_1") == 2


def test_a_terminal_shows_control_characters_and_does_not_obey_them() -> None:
    shown = text_of(Table.of_texts(["a\x1b]0;b"], rows=[["c\x1b[2J\x9b\nd"]]), 80)
    assert r"a\x1b]0;b" in shown and r"c\x1b[2J\x9b" in shown and "\x1b" not in shown and "\x9b" not in shown
    assert text_of("one\n\ttwo \x07", 80) == "one\n        two \\x07\n"


def test_texts_below_a_title_are_broken_and_others_are_whole() -> None:
    columns = (Column("name", number=False, least=9), Column("about", number=False, wraps=True))
    table = Table.of(columns, [{"name": "vehicle_1", "about": "drives straight on"}], title="Vehicles")
    assert lines(table, 20) == ["Vehicles", "name about", "vehicle_1 drives", "straight", "on"]


def test_records_have_the_formats_and_units_of_their_columns() -> None:
    columns = (Column("name", "", number=False), Column("error_m", "RMSE", "m", column), Column("count"))
    table = Table.of(
        columns, [{"name": "a", "error_m": 0.5, "count": 3}, {"name": "b|c", "error_m": np.nan, "count": 4}]
    )
    assert table.markdown() == "|  | RMSE [m] | count |\n|---|---|---|\n| a | 0.500 | 3 |\n| b\\|c | - | 4 |"
    assert lines(table, 40) == ["RMSE", "[m] count", "a 0.500 3", "b|c - 4"]
    assert table.csv() == "name,error_m,count\na,0.5,3\nb|c,,4\n"


def test_data_have_units_by_their_names() -> None:
    table = Table.of_data({"name": ["b", "a"], "way_m": np.array([1.0, np.inf]), "count": [1, 2]}, ("name",))
    assert table.csv() == "name,way_m,count\nb,1.0,1\na,,2\n"
    assert table.units == {"way_m": "m", "count": "1"}


def test_markdown_has_no_tags_and_one_line_per_row() -> None:
    assert markdown(("a", "b"), [("x\ny", "<car>")]) == "| a | b |\n|---|---|\n| x; y | &lt;car> |"
    assert bullets(["one  <two>\nthree"]) == "- one &lt;two> three"


def test_latex_escapes_stacks_and_spans() -> None:
    table = Table.of_texts([""], ["f1", "f2"], [("split_\nfilter", "1", "2"), ("50 %", "both")], rules=[1])
    text = table.latex("of a test")
    assert text.startswith("% of a test\n") and r"\begin{tabular}{@{}lrr@{}}" in text and r" & f1 & f2 \\" in text
    assert r"\shortstack[l]{split\_\\filter} & 1 & 2 \\" in text
    assert "\\midrule\n50 \\% & \\multicolumn{2}{l}{both} \\\\\n\\bottomrule" in text


def test_a_table_of_other_cells_than_columns_is_refused() -> None:
    with pytest.raises(ValueError, match="zip"):
        Table.of_texts(["a"], rows=[("1", "2")])
