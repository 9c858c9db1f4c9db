"""Tests and throughput of coopenv on a GPU, in one command: `make gpu`, or `python -m benchmarks.gpu`."""
