"""Properties of viser's handles, given to viser only where they have changed: most of what is drawn stays as it was."""

from typing import Any

import numpy as np


class Sent:
    """A handle, and what it was told last."""

    def __init__(self, handle: Any) -> None:
        """Begin with a handle that has been told nothing."""
        self.handle = handle
        """viser's."""
        self._last: dict[str, Any] = {}

    def tell(self, **properties: Any) -> None:
        """Set properties; an array that is given must not be changed afterwards."""
        for name, value in properties.items():
            last = self._last.get(name)
            if isinstance(value, np.ndarray):
                if last is value or (last is not None and np.array_equal(last, value)):
                    continue
            elif last == value:
                continue
            self._last[name] = value
            setattr(self.handle, name, value)
