"""Text for people: one tidy table, its forms on a terminal and in files, and the templates of documents."""
