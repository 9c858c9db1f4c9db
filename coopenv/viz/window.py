"""A window that shows pictures, where there is a display; elsewhere it stays silent."""

from typing import Any

import numpy as np


class Window:
    """One window, opened by the first picture and reused by the next ones."""

    def __init__(self, title: str) -> None:
        self._title, self._silent = title, False
        self._image: Any = None

    @property
    def canvas(self) -> Any:
        """Matplotlib's canvas, which tells of keys; None before the first picture and without a display."""
        return None if self._image is None else self._image.figure.canvas

    @property
    def is_open(self) -> bool:
        """Whether there is a window that the user has not closed."""
        if self._image is None:
            return False
        from matplotlib import pyplot as plt

        return bool(plt.fignum_exists(self._image.figure.number))

    def show(self, picture: np.ndarray) -> None:
        """Show an (H, W, 3) uint8 picture and let the window react to the user, who may close it for good."""
        if self._image is None and not self._silent:
            self._image = _opened(self._title, picture)
        if self._image is None:
            self._silent = True
        elif self.is_open:
            self._image.set_data(picture)
            self.canvas.draw_idle()
            self.canvas.flush_events()

    def close(self) -> None:
        """Close the window; the next picture opens a new one."""
        if self._image is not None:
            from matplotlib import pyplot as plt

            plt.close(self._image.figure)
        self._image, self._silent = None, False


def _opened(title: str, picture: np.ndarray) -> Any:
    """Return the picture of a new window; None where there is no display or no interactive backend."""
    try:
        from matplotlib import pyplot as plt
        from matplotlib.backends.registry import BackendFilter, backend_registry

        if plt.get_backend().lower() not in backend_registry.list_builtin(BackendFilter.INTERACTIVE):
            return None
        dpi = 100
        figure = plt.figure(num=None, figsize=(picture.shape[1] / dpi, picture.shape[0] / dpi), dpi=dpi)
    except Exception:  # each toolkit has its own way to say that it is not installed or finds no display
        return None
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    manager: Any = figure.canvas.manager
    figure.canvas.mpl_disconnect(manager.key_press_handler_id)  # keys are not matplotlib's here
    manager.set_window_title(title)
    manager.show()
    return ax.imshow(picture)
