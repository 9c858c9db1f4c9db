"""Studies of the observer `robust` in many worlds, whose tables `docs/robust_evidence.md` holds.

Usage: python -m benchmarks.robust depth           # one of depth, drawn, errors, camera, lies, search, meetings
"""
