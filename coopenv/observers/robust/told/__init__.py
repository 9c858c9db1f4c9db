"""The observer `robust`: a vehicle tells its pose and, in turn, how its error correlates with those of whom it hears.

Whom it hears stands where it says that it is, and its error is considered; see fusion.py.
"""
