"""Legibility of figures: text lies within the figure and has enough contrast, in every width."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Text

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.cli.options import FigureColumn
from coopenv.viz import FIGURE_NAMES, figures, style
from coopenv.viz.figures import draw_figure
from coopenv.viz.style import LEAST, contrast
from coopenv.viz.topview import TopView
from coopenv.viz.topview_ground import ASPHALT, GROUND, ROOF
from tests.helpers.env_suite import rest_slow
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.synthetic import make_trajectory

SLACK = 0.02  # inches, of the renderer's rounding
WIDE = ("errors", "consistency")


def shown_texts(figure: Figure) -> Iterator[Text]:
    """Yield what is written."""
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip():
            yield text


@pytest.mark.parametrize(
    ("name", "width"), [*product(FIGURE_NAMES, [None, "ieee1"]), *rest_slow(product(WIDE, ["springer2"]))]
)
def test_no_text_is_cut_and_all_of_it_stands_out(name: str, width: str | None) -> None:
    run = make_trajectory(ticks=601, noise=0.02)
    figure = draw_figure(name, run, scenario=coopenv.load_scenario(FOUR_WAY), width=width, gain=True)
    style.sign(figure, "crossing_path, robust, seed 0")
    figure.draw_without_rendering()
    drawn, size = figure.get_tightbbox(), figure.get_size_inches()  # of all that is drawn, inches
    assert drawn.x0 >= -SLACK and drawn.x1 <= size[0] + SLACK
    assert drawn.y0 >= -SLACK and drawn.y1 <= size[1] + SLACK
    texts = list(shown_texts(figure))
    assert len(texts) > 5
    for text in texts:
        assert contrast(text.get_color()) >= LEAST and text.get_alpha() in (None, 1.0), text.get_text()
    if width is not None:
        assert figure.get_figwidth() == pytest.approx(figures.COLUMNS[width].inches)
        assert min(text.get_fontsize() for text in texts) >= 5.5


def test_words_of_the_top_view_stand_out_from_ground_road_and_roof() -> None:
    view = TopView(coopenv.load_scenario("urban_crossing"))
    for text in shown_texts(view._figure):
        colour = text.get_color()
        assert min(contrast(colour, behind) for behind in ("white", GROUND, ASPHALT, ROOF)) >= LEAST, text.get_text()


def test_contrast_is_that_of_wcag() -> None:
    assert contrast("black") == contrast("white", "black") == pytest.approx(21.0)
    assert contrast("#777777") == pytest.approx(4.48, abs=0.005)  # WebAIM: just not enough
    assert contrast("#0072B2") == pytest.approx(5.19, abs=0.02)
    assert contrast("#FF0000", "black") == pytest.approx((0.2126 + 0.05) / 0.05)
    assert contrast(style.NOTE) >= LEAST and contrast(style.INK) >= LEAST


def test_a_style_gives_figures_of_the_columns_width(tmp_path: Path) -> None:
    assert set(figures.COLUMNS) == {column.value for column in FigureColumn}
    inches = {"ieee1": 3.5, "ieee2": 7.16, "springer1": 84 / 25.4, "springer2": 174 / 25.4}
    before = dict(mpl.rcParams)
    for name, width in inches.items():
        with mpl.rc_context(figures.style(name)):
            figure = Figure()
            ax = figure.add_subplot()
            ax.plot([0, 1], [0, 1], label="a")
            ax.set_xlabel("time [s]")
            ax.legend()
            figure.savefig(tmp_path / f"{name}.pdf")
            assert figure.get_figwidth() == pytest.approx(width)
            assert ax.xaxis.label.get_fontsize() == figures.COLUMNS[name].size
            assert to_rgba(ax.lines[0].get_color()) == to_rgba(style.VEHICLE_COLOURS[0])
        assert (tmp_path / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    assert dict(mpl.rcParams) == before


def test_an_unknown_column_or_figure_is_an_error_with_the_known_ones() -> None:
    with pytest.raises(CoopenvError, match=r"unknown width 'ieee' \(did you mean 'ieee.'\?\); known: ieee1, ieee2"):
        figures.style("ieee")
    with pytest.raises(CoopenvError, match="unknown figure 'error'"):
        draw_figure("error", make_trajectory(ticks=20))


@pytest.fixture(scope="module")
def alike() -> list[Figure]:
    return [draw_figure("trajectories_2d", make_trajectory(ticks=60), width="ieee1") for _ in range(2)]


@pytest.mark.parametrize("file_format", ["png", "pdf", "svg"])
def test_files_have_metadata_and_are_the_same_each_time(file_format: str, alike: list[Figure], tmp_path: Path) -> None:
    about = {"environment": "overtaking", "observer": "robust", "seed": 3}
    path = tmp_path / f"f.{file_format}"
    content, again = (style.save(figure, path, about=about).read_bytes() for figure in alike)
    assert content == again
    text = content.decode("latin-1")
    assert "environment: overtaking; observer: robust; seed: 3" in text
    if file_format == "png":
        assert imread(path).shape[1] == pytest.approx(3.5 * style.DPI, abs=1)


def test_gain_matrices_are_not_shown_as_covariances() -> None:
    figures = [draw_figure("consistency", make_trajectory(ticks=60), gain=gain) for gain in (True, False)]
    assert ["gain matrix" in figure.get_supxlabel() for figure in figures] == [True, False]
    scenario = coopenv.load_scenario("busy_intersection")
    env = coopenv.parallel_env("busy_intersection", render_mode="rgb_array")
    env.reset(seed=0)
    for name, drawn in (("riccati", 0), ("robust", 5)):
        env.engine.view("covariance")[0] = 0.01 * np.eye(6)
        env.engine.view("estimate_position")[0] = 0.0
        env.engine.refresh()
        view = TopView(scenario.model_copy(update={"observer": scenario.observer.model_copy(update={"name": name})}))
        view.draw(env.engine)
        assert sum(np.isfinite(path.vertices).all() for path in view._ellipses.get_paths()) == drawn
