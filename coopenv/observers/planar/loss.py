"""Whether a robot has lost its way: bearings that do not fit its estimate, over a window."""

import math
from collections import deque

REFUSED = 16.0  # normalised innovation squared (4 standard deviations) of a bearing that does not fit
WINDOW = 10  # bearings
MOST_REFUSED = 6  # of them
LONG_WINDOW = 30
HIGHEST_MEAN = 5.0  # of the normalised innovation squared over the long window, 1 for an honest filter
LARGEST = 25.0  # that one bearing counts in it
FITS = 9.0  # the same up to which a bearing to a landmark shows that the robot is not lost
TRUST_S = 15.0  # for so long; meanwhile a robot whose bearings do not fit is itself lost, or lies
SHORTEST_S = 1.0  # that the window must span: one bad frame is no loss


class LossTest:
    """The normalised innovations squared of one robot's last bearings."""

    def __init__(self) -> None:
        self._last: deque[tuple[float, float]] = deque(maxlen=LONG_WINDOW)
        self._sure = -math.inf

    def clear(self) -> None:
        """Forget them."""
        self._last.clear()
        self._sure = -math.inf

    def take(self, time: float, ratio: float) -> None:
        """Take the normalised innovation squared of a bearing to a landmark at a time in s."""
        if ratio <= FITS:
            self._sure = time
        self._last.append((time, min(ratio, LARGEST)))

    def take_of_robot(self, time: float, ratio: float) -> None:
        """Take that of a bearing to or from a robot, which counts where no landmark was seen lately."""
        if not self.sure(time):
            self._last.append((time, min(ratio, LARGEST)))

    def sure(self, time: float) -> bool:
        """Return whether a landmark showed lately that the robot is not lost."""
        return time - self._sure <= TRUST_S

    @property
    def since(self) -> float:
        """When the first of the last bearings that do not fit was seen, s."""
        refused = [time for time, ratio in list(self._last)[-WINDOW:] if ratio > REFUSED]
        return refused[0] if refused else -math.inf

    @property
    def lost(self) -> bool:
        """Whether most of the last bearings do not fit, or all together fit badly."""
        last = list(self._last)
        short = last[-WINDOW:]
        lasting = len(short) == WINDOW and short[-1][0] - short[0][0] >= SHORTEST_S
        if lasting and sum(ratio > REFUSED for _, ratio in short) >= MOST_REFUSED:
            return True
        return len(last) == LONG_WINDOW and sum(ratio for _, ratio in last) > HIGHEST_MEAN * LONG_WINDOW
