"""SUMO as a co-simulator."""
