"""Figures of runs, drawn without a display and without touching matplotlib's global state."""
