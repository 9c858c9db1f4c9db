"""Scenes that are made to measure: lanes, trees, random graphs and rings of any number of vehicles.

Wherever an environment is taken by name, `lane:20` or `random:12,seed=3` stands for one of these. They are for
observers: who measures whom is given, nobody drives, and there is a Cramer-Rao bound for each.
"""

from coopenv.scenario.scenes.request import SCENES, scene_rows
from coopenv.scenario.scenes.text import scene_text

__all__ = ["SCENES", "scene_rows", "scene_text"]
