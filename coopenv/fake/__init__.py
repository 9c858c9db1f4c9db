"""Fake SVEA cars: processes that say and do on the network what the real ones would."""
