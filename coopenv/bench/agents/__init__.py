"""`coopenv evaluate`: drivers on the same held-out worlds, with intervals, figures, a film and cards."""
