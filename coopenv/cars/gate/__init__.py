"""The gate on a car's own computer: the only process that commands the wheels.

It starts quickly and needs neither NumPy nor the simulation. `core` decides, `codec` reads and writes its few messages,
`process` connects it to the network. `core` explains the conditions of a command.
"""
