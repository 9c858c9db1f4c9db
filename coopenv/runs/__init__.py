"""One run of an environment: simulate, judge and save it."""

from typing import TYPE_CHECKING

from coopenv.base import lazy_names

if TYPE_CHECKING:
    from coopenv.runs.recorder import record
    from coopenv.runs.rollouts import Rollout, rollout
else:
    __getattr__, __dir__ = lazy_names(__name__)

__all__ = ["Rollout", "record", "rollout"]
