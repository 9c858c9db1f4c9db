"""Scenes in the browser, drawn by viser: a page that plays an episode from a file, and the live view."""
