"""The observer `robust`: a vehicle tells its pose and, at times, how its error correlates with those of whom it hears.

Whom it hears stands where it says that it is, and its error is considered; see fusion.py.
"""
