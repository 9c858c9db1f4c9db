"""What a picture of a world shows, as plain data: the stage that stands still, and a frame per drawn tick.

The top view, the page in the browser and films are made from these alone, whether a world runs, has been recorded or is
the one of real cars.
"""

from coopenv.viz.scene.record import SceneRecord, SceneWriter, Source
from coopenv.viz.scene.stage import Frame, Shown, Stage

__all__ = ["Frame", "SceneRecord", "SceneWriter", "Shown", "Source", "Stage"]
