"""The observer `robust_joint`: a vehicle sends its belief, up to `MAX_TOLD` vehicles and 1.7 kB.

What could reach a receiver by two ways is recognised: a sender whose message is superseded, because another one's tells
of it, adds nothing of its own. So along a leader-follower graph no information is lost, and none counts twice.
"""
