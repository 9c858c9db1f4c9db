"""Observers for robots on a plane whose odometry is their commands."""
