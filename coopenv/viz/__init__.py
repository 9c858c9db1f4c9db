"""Figures of runs, drawn without a display and without touching matplotlib's global state."""

FORMATS = ("png", "pdf", "svg")
"""Formats of the files that figures are written to."""
FIGURE_NAMES = ("errors", "trajectories_2d", "trajectories_3d", "topology", "consistency", "observability")
"""Figures of a run."""
