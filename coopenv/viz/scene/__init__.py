"""The content of a picture of a world, as plain data: the static stage, and a frame per drawn tick.

The top view, the page in the browser and films are made from these alone, whether a world runs, has been recorded or is
the one of real cars.
"""

from coopenv.viz.scene.record import SceneRecord, SceneWriter, Source
from coopenv.viz.scene.stage import Frame, FrameSource, Stage

__all__ = ["Frame", "FrameSource", "SceneRecord", "SceneWriter", "Source", "Stage"]
