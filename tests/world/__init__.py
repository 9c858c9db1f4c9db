"""Tests of the simulated world, and what they share: scenario builders and callers of Warp functions."""
