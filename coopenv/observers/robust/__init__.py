"""The observer `robust` as Warp functions: observer.py is one tick, and the place to begin.

Per tick: joint_state.py (odometry), correlated_fusion.py (messages), correction.py (bearings, which observer.py gates),
integrity.py (faults of sources), fault_hypotheses.py (which source is excluded). search.py finds a lost pose. The
functions run embedded in the world's kernels, and for one vehicle on the host.
"""
