"""Kinds of measurements: what each one predicts, its residual and its derivatives, one file per kind.

`kinds` has the table of kinds and `Kind`, which each kind implements; `own` makes a kind of a user's class;
`sensor` has a sensor of a vehicle: a kind with a mounting, noise and targets.
"""
