"""The gate on a car's own computer: what stands between the network and the wheels.

It starts quickly and needs neither NumPy nor the simulation. `core` decides, `codec` reads and writes its few messages,
`process` connects it to the network. How commands come through is told in `core`.
"""
