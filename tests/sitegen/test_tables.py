"""Cells of tables that need room are marked, others are not."""

from __future__ import annotations

import pytest

from sitegen.tables import marked


@pytest.mark.parametrize(
    ("cell", "kind"),
    [
        ("<td>pure pursuit of its way at full speed, gives way</td>", "words"),
        ('<td style="text-align: left;">pure <code>pursuit</code> of its way at full speed</td>', "words"),
        ("<td>23.5 [23.4, 23.6]</td>", "interval"),
        ("<td>23 % [17, 26]</td>", "interval"),
        ("<td>-16 [-29, 1]</td>", "interval"),
        ("<td>scripted</td>", ""),
        ('<td><a href="a/long/address/that/is/no/text.html">short</a></td>', ""),
        ('<td class="own">pure pursuit of its way at full speed, gives way</td>', ""),
    ],
)
def test_cells(cell: str, kind: str) -> None:
    wanted = cell.replace(">", f' class="{kind}">', 1) if kind else cell
    assert marked(f"<tr>{cell}</tr>") == f"<tr>{wanted}</tr>"
