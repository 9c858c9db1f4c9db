"""Roads, traffic and dynamics of highway-env under this project's cameras, radio and observers."""

from coopenv.backends.highway.backend import Highway

__all__ = ["Highway"]
