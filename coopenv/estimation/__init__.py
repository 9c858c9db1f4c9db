"""Observers, observability and the measures by which an estimate is judged."""
