"""Cells of tables that need room are marked, others are not."""

from __future__ import annotations

import re

import pytest

from sitegen.tables import marked


@pytest.mark.parametrize(
    ("cell", "kind"),
    [
        ("<td>pure pursuit of its way at full speed, gives way</td>", "words"),
        ('<td style="text-align: left;">pure <code>pursuit</code> of its way at full speed</td>', "words"),
        ("<td>23.5 [23.4, 23.6]</td>", "numbers"),
        ("<td>23 % [17, 26]</td>", "numbers"),
        ("<td>-16 [-29, 1]</td>", "numbers"),
        ("<td>0.0133 ± 0.0050 m (0.0286)</td>", "numbers"),
        ("<td>&lt; 1e-13 m</td>", "numbers"),
        ("<td>17 k .. 103 k</td>", "numbers"),
        ("<th>95 %</th>", "numbers"),
        ("<td>(-9.2, 0.8, 0.3)</td>", ""),
        ("<td>2.93, 7.73, 9.70</td>", ""),
        ("<th>a column with a head of many words</th>", ""),
        ("<td>scripted</td>", ""),
        ('<td><a href="a/long/address/that/is/no/text.html">short</a></td>', ""),
        ('<td class="own">pure pursuit of its way at full speed, gives way</td>', ""),
    ],
)
def test_cells(cell: str, kind: str) -> None:
    wanted = cell.replace(">", f' class="{kind}">', 1) if kind else cell
    assert marked(f"<tr>{cell}</tr>") == f"<tr>{wanted}</tr>"


@pytest.mark.parametrize(
    ("cell", "whole"),
    [
        ("2e-9 m, 3e-8 deg", ["2e-9 m", "3e-8 deg"]),
        ("settled (0.5 m, 5 deg)", ["0.5 m", "5 deg"]),
        ("yaw 0 deg; +- 2.865 deg and more words", ["0 deg", "+- 2.865 deg"]),
        ("error &lt; 0.1 m after 3 s, in 20/20 runs", ["&lt; 0.1 m", "3 s", "20/20"]),
        ("noise 0.05 m/s and 0.03 rad/s, loss 5 %", ["0.05 m/s", "0.03 rad/s", "5 %"]),
        ("seed 1 of SL-1 and v2.0 makes 3 steps, see <code>1 m</code>", []),
    ],
)
def test_numbers_stay_with_their_units(cell: str, whole: list[str]) -> None:
    page = marked(f"<tr><td>{cell}</td></tr>")
    assert re.findall(r'<span class="quantity">(.*?)</span>', page) == whole
    assert re.sub(r"</?span[^>]*>", "", page).replace(' class="words"', "") == f"<tr><td>{cell}</td></tr>"
