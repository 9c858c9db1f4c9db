"""What `env.reset(options={...})` takes on cars, and on what they have recorded."""

from collections.abc import Mapping
from typing import Any

from coopenv.errors import CoopenvError, shown, suggest

OPTIONS = ("arm", "options")
"""The second one is passed by PettingZoo's own tests and means nothing."""


def wants_to_arm(options: Mapping[str, Any]) -> bool:
    """Return whether cars are to drive: the option `arm`.

    Raises:
        CoopenvError: an option is not known, or not what it must be.
    """
    for key in options:
        if key not in OPTIONS:
            raise CoopenvError(f"unknown option {shown(key)}{suggest(str(key), OPTIONS)}; known: arm")
    arm = options.get("arm", False)
    if not isinstance(arm, bool):
        raise CoopenvError(f"option 'arm' must be true or false, got {shown(arm)}")
    return arm
