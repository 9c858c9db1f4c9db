"""Views of logs for Foxglove and Lichtblick."""
