"""Hostile input, drawn from fixed seeds: nothing crashes, hangs, raises what is not ours, or lets NaN through."""
