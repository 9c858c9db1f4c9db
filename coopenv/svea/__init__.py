"""SVEA cars: names, messages, transports and the command gate, without anything of the simulation.

What runs on a car's own computer is here; it needs the extra `svea`.
"""
