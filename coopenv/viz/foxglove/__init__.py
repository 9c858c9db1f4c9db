"""What Foxglove and Lichtblick show of a recording: its scene, transforms, cameras and estimates.

Messages are of Foxglove's published types, which its SDK encodes; the extra `log` brings it.
"""

from coopenv.viz.foxglove.views import check_installed, layout_text, views

__all__ = ["check_installed", "layout_text", "views"]
