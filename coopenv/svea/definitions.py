"""Definitions of the messages that are in no list of standard types: fields, types and order are those on the wire."""

CAMERA = {
    "pixy_camera/msg/ObjectInfo": """
int32 signature
int32 center_x
int32 center_y
int32 width
int32 height
int32 angle
int32 index
int32 age
""",
    "pixy_camera/msg/ObjectInfoArrayStamped": """
std_msgs/Header header
pixy_camera/ObjectInfo[] objects
""",
    "pixy_camera/msg/ObjectBearing": """
int32 id
float32 bearing_x
float32 bearing_y
float32 bearing_z
""",
    "pixy_camera/msg/ObjectBearingArrayStamped": """
std_msgs/Header header
pixy_camera/ObjectBearing[] bearing
""",
}
"""Of the camera, in ROS 1 and ROS 2."""

ROS_1 = {
    **CAMERA,
    "svea_msgs/msg/lli_ctrl": """
int8 steering
int8 velocity
int8 trans_diff
int8 ctrl
""",
    "svea_msgs/msg/lli_emergency": """
bool emergency
uint32 sender_id
""",
    "svea_msgs/msg/VehicleState": """
std_msgs/Header header
string child_frame_id
float64 x
float64 y
float64 yaw
float32 v
float64[16] covariance
""",
}

TICK = "coopenv_msgs/msg/Tick"
"""Type of the marks in a file of a drive."""

STOPPED = "coopenv_msgs/msg/Stopped"
"""Type of the message that tells there why the watchdog stopped the cars."""

ROS_2 = {
    **CAMERA,
    "mavros_msgs/msg/ManualControl": """
std_msgs/Header header
float32 x
float32 y
float32 z
float32 r
uint16 buttons
uint16 buttons2
uint8 enabled_extensions
float32 s
float32 t
float32 aux1
float32 aux2
float32 aux3
float32 aux4
float32 aux5
float32 aux6
""",
    "mavros_msgs/msg/State": """
std_msgs/Header header
bool connected
bool armed
bool guided
bool manual_input
string mode
uint8 system_status
""",
    "mavros_msgs/msg/RCIn": """
std_msgs/Header header
uint8 rssi
uint16[] channels
""",
    "ackermann_msgs/msg/AckermannDrive": """
float32 steering_angle
float32 steering_angle_velocity
float32 speed
float32 acceleration
float32 jerk
""",
    "ackermann_msgs/msg/AckermannDriveStamped": """
std_msgs/Header header
ackermann_msgs/AckermannDrive drive
""",
    "coopenv_msgs/msg/RobustReport": """
std_msgs/Header header  # frame_id: map
bool valid  # false: the sender does not know where it is
geometry_msgs/Pose pose  # of the body
float64[36] covariance  # rotation (rad), then position (m); see docs/robust.md
geometry_msgs/Pose odometry  # dead reckoning since the start
uint64 depends_on  # a bit per vehicle whose information is in it
""",
    TICK: """
std_msgs/Header header
int64 index  # 0: an episode begins
uint64 key  # of its random draws
uint32 episode
""",
    STOPPED: """
std_msgs/Header header
string reason
string car  # whose fault it was; empty: nobody's
""",
    "coopenv_msgs/msg/Arm": """
std_msgs/Header header
string session  # of which commands are to be accepted
string nonce  # that the gate has shown last
bool armed  # false: disarm
""",
    "coopenv_msgs/msg/GateStatus": """
std_msgs/Header header
string session  # empty: none
string nonce
string state  # disarmed, armed, timed_out, stopped
uint64 accepted
uint64 last_sequence
string[] rejections  # reasons
uint64[] counts  # how often each
""",
}
