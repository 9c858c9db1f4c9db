"""Top views of an engine's worlds, for every interface that draws."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from coopenv.api.engine import Engine
from coopenv.scenario import Scenario
from coopenv.viz.scene.frame import Frame

if TYPE_CHECKING:
    from coopenv.viz.topview import TopView


class Pictures:
    """Draws worlds of an engine; matplotlib is loaded with the first picture."""

    def __init__(self, engine: Engine, scenario: Scenario) -> None:
        self._engine, self._scenario = engine, scenario
        self._view: TopView | None = None

    def of(self, world: int = 0) -> np.ndarray:
        """Return an (H, W, 3) uint8 picture of a world."""
        return self.view.paint(Frame.of(self._engine, world))

    def show(self) -> None:
        """Draw the first world in a window."""
        self.view.show(self.of())

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None

    @property
    def view(self) -> TopView:
        """What draws, made when it is first asked for."""
        if self._view is None:
            from coopenv.viz.topview import TopView

            self._view = TopView(self._scenario)
        return self._view
