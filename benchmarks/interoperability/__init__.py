"""First examples of other projects, with coopenv."""
