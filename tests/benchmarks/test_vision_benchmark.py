"""The benchmark of the detector of tags: a table of plausible figures, and one line for what is wrong."""

from __future__ import annotations

import pytest

pytest.importorskip("cv2", reason="needs the extra 'vision'")

from benchmarks import vision


def test_near_tags_are_found_and_the_table_has_a_row_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert vision.main(["--frames", "10"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[3:]]
    assert len(rows) == len(vision.DISTANCES) * len(vision.TILTS) + 1 and rows[-1][0] == "all"
    for distance, _, share, rmse, _, false, *_ in rows[:-1]:
        if float(distance) <= 2.0:
            assert share == "100.0(0.0)" and float(rmse.split("(")[0]) < 0.05 and false == "0"
