"""Cases of which one crashes, one hangs and one raises: in a module of its own, which is loaded at once."""

from __future__ import annotations

import os
import signal
import time


def case(number: int) -> str:
    """Crash (1), hang (2), raise (4), or go well."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGSEGV)
    if number == 2:
        time.sleep(1000)
    if number == 4:
        raise ZeroDivisionError
    return "accepted"
