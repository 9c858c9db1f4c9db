"""Fake cars: processes with the topics of real cars, their settings, faults, sensors and world."""
