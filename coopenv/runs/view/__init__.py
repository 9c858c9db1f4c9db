"""`coopenv view`: an episode, a record or cars, live in the browser."""
