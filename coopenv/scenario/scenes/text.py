"""A scene as the text of a scenario file, which can be kept and changed."""

from collections.abc import Sequence

from coopenv.scenario.scenes.layouts import LANDMARKS, Placed, Straight
from coopenv.scenario.scenes.request import SCENES, read_request

LEG = 40.0  # s in one direction of a street
LONGEST = 600.0  # s for which streets are driven to and fro

HEAD = """\
#:schema ../docs/scenario.schema.json
title = "{title}"
description = \"\"\"
{about}
Starts are up to 10 deg and 1 m off; bearings have the noise of busy_intersection_tracking.\"\"\"
source = "made by: coopenv scene {name}"
horizon = 50.0 # of at most {longest:g} s, after which those who drive to and fro stand still

[rates]
camera = 60.0
odometry = 60.0
decision = 10.0

[camera]
model = "omnidirectional"
orientation = "body"

[noise]
velocity = 0.1          # m/s
angular_velocity = 0.01 # rad/s
odometry_rate = "sample"
bearing.model = "isotropic"
bearing.scale = 0.002886751345948129 # rad: 0.005 / sqrt(3)
bearing.rate = "sample"

[topology]
mode = "fixed"
acyclic = {acyclic}

[observer]
k = 1.0
q = 10.0
V = [0.1, 1.0]
P0 = [1.0, 100.0]

[observation]
position_scale = {scale:.0f}.0
velocity_scale = 2.0
angular_velocity_scale = 1.0
"""

DEFAULTS = """
[vehicle_defaults]
initial_estimate.orientation_angle = 0.17453292519943295 # rad: up to 10 degrees about any axis
initial_estimate.position_radius = 1.0 # m
"""


def scene_text(name: str) -> str:
    """Return the scenario file of a scene such as `lane:20`.

    Raises:
        UnknownEnvironmentError: no such scene or option, or a number that is not allowed.
    """
    request = read_request(name)
    placed, options = request.vehicles, ", ".join(f"{key} {value}" for key, value in request.options.items())
    head = HEAD.format(
        title=f"{request.kind.capitalize()}: {options}",
        about=SCENES[request.kind].about,
        name=f"{request.kind}:" + ",".join(f"{key}={value}" for key, value in request.options.items()),
        longest=LONGEST,
        acyclic=str(request.kind != "ring").lower(),
        scale=max(40.0, *(abs(x) for vehicle in placed for x in vehicle.position)),
    )
    landmarks = "".join(f'\n[[landmarks]]\nname = "{n}"\nposition = {_vector(p)}\n' for n, p in LANDMARKS.items())
    return head + landmarks + DEFAULTS + "".join(map(_vehicle, placed))


def _vehicle(placed: Placed) -> str:
    names = ", ".join(f'"{name}"' for name in placed.neighbours)
    yaw = f"initial_pose.yaw = {placed.yaw:.6g}\n" if placed.yaw else ""
    return (
        f"\n[[vehicles]]\ninitial_pose.position = {_vector(placed.position)}\n{yaw}"
        f"motion = {_motion(placed)}\nneighbours = [{names}]\n"
    )


def _motion(placed: Placed) -> str:
    motion = placed.motion
    if not isinstance(motion, Straight):
        twist = f"linear = [{motion.speed:.6g}, 0.0, 0.0], angular = [0.0, 0.0, {motion.turn:.6g}]"
        return f'{{ kind = "constant", {twist} }}'
    back = tuple(-x for x in motion.velocity)
    legs = [motion.velocity if n % 2 == 0 else back for n in range(round(LONGEST / LEG))]
    rows = ",\n".join(f"  {{ duration = {LEG}, linear = {_vector(leg)} }}" for leg in legs)
    return f'{{ kind = "segments", segments = [\n{rows},\n] }}'


def _vector(values: Sequence[float]) -> str:
    return f"[{', '.join(repr(round(float(x), 4) + 0.0) for x in values)}]"
