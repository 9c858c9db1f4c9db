"""A window that shows pictures, where there is a display; elsewhere it stays silent."""

from __future__ import annotations

from typing import Any

import numpy as np


class Window:
    """One window, opened by the first picture and reused by the next ones."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._figure: Any = None
        self._image: Any = None
        self._silent = False

    def show(self, picture: np.ndarray) -> None:
        """Show an (H, W, 3) uint8 picture and let the window react to the user, who may close it for good."""
        if self._silent:
            return
        if self._figure is None and not self._open(picture):
            self._silent = True
            return
        from matplotlib import pyplot as plt

        if not plt.fignum_exists(self._figure.number):
            self._silent = True
            return
        self._image.set_data(picture)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()

    def close(self) -> None:
        """Close the window; the next picture opens a new one."""
        if self._figure is not None:
            from matplotlib import pyplot as plt

            plt.close(self._figure)
        self._figure = self._image = None
        self._silent = False

    def _open(self, picture: np.ndarray) -> bool:
        """Open a window; return False where there is no display or no interactive backend."""
        try:
            from matplotlib import pyplot as plt
            from matplotlib.backends.registry import BackendFilter, backend_registry

            interactive = backend_registry.list_builtin(BackendFilter.INTERACTIVE)
            if plt.get_backend().lower() not in interactive:
                return False
            dpi = 100
            size = (picture.shape[1] / dpi, picture.shape[0] / dpi)
            self._figure = plt.figure(num=None, figsize=size, dpi=dpi)
        except Exception:  # each toolkit has its own way to say that it is not installed or finds no display
            return False
        ax = self._figure.add_axes((0, 0, 1, 1))
        ax.set_axis_off()
        self._image = ax.imshow(picture)
        manager = self._figure.canvas.manager
        manager.set_window_title(self._title)
        manager.show()
        return True
