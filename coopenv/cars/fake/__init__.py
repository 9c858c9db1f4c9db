"""Fake cars: processes that publish and accept what real cars do."""
