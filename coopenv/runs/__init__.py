"""One run of an environment: simulate it, judge it, write it down."""

from coopenv.runs.recorder import record
from coopenv.runs.rollouts import Rollout, rollout

__all__ = ["Rollout", "record", "rollout"]
