"""Flags of vehicles under way alone, for libraries that sum rewards by row; copy this file beside your program."""

from typing import Any

from gymnasium.vector import VectorWrapper


class TrueEnds(VectorWrapper):
    """Reports `terminated` and `truncated` of vehicles under way alone; works in every autoreset mode.

    A vehicle that ended before its world stays parked, and its row is not `truncated` once more when the world is over:
    the time until then reads as the beginning of its next episode, with reward 0 and without effect of its actions. So
    returns summed by wrappers, such as Gymnasium's `RecordEpisodeStatistics`, are those of true episodes; their
    lengths contain the time parked.
    """

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the batch."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        alive = infos.get("final_info", infos)["alive"]
        truncated = truncated & alive
        if "final_info" in infos:
            ended = terminated | truncated
            infos = {**infos, "_final_obs": ended, "_final_info": ended}
        return observations, rewards, terminated, truncated, infos
