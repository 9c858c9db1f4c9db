"""Motion of a vehicle under a command: a row of `table` and a file of Warp functions for each kind.

`command` holds what all kinds share: entries of a command, limits and lags. `dispatch` calls the kind of each vehicle.
`own` is the contract of a user's own drive, see docs/contributing/vehicle.md.
"""
