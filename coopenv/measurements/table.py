"""The table of shipped kinds of measurements; reading a scenario needs no more of them."""

KINDS: dict[str, str] = {
    "bearing": "bearing:Bearing",
    "range": "range:Range",
    "range_bearing": "range_bearing:RangeBearing",
    "position": "position:Position",
    "attitude": "attitude:Attitude",
    "relative_pose": "relative_pose:RelativePose",
}
"""Shipped kinds by name: module of this package and class."""
