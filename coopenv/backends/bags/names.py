"""Names of topics that are known by themselves: {car}, {agent} and {body} stand for those of a car."""

from coopenv.svea.topics import TOPICS, Role, topic_of

READ = (
    *(Role.DETECTIONS, Role.BEARINGS, Role.CAMERA_INFO, Role.WHEEL, Role.IMU, Role.ODOMETRY),
    *(Role.ESTIMATE, Role.POINT, Role.TRUTH),
)
"""Roles that are of use in a bag."""

PATTERNS: dict[str, dict[Role, tuple[str, ...]]] = {
    "svea": {
        **{role: (f"/{topic_of('{car}', role)}", f"/{{car}}/{TOPICS[role].suffix}") for role in READ if role in TOPICS},
        Role.TRUTH: tuple(f"/{fleet}qualisys/{{body}}/{kind}" for fleet in ("fleet/", "") for kind in ("odom", "pose")),
    },
    "authors": {
        Role.DETECTIONS: ("/{agent}/pixy_node/objectsInfo",),
        Role.BEARINGS: ("/{agent}/pixy_landmark_detection/objectsBearing",),
        Role.CAMERA_INFO: ("/{agent}/pixy_node/camera_info",),
        Role.WHEEL: ("/{agent}/actuation_twist",),
        Role.POINT: ("/{agent}/riccatiPoint",),
        Role.TRUTH: ("/qualisys/{body}/pose", "/qualisys/{body}/odom"),
    },
    "none": {},
}
"""By name and role: the first of them that a bag has counts."""
