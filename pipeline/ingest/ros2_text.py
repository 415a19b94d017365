"""ROS 2 message definitions that this project writes, in the concatenated form that MCAP wants."""

from __future__ import annotations

_SEPARATOR = "=" * 80

_TIME = "int32 sec\nuint32 nanosec\n"
_HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"
_VECTOR3 = "float64 x\nfloat64 y\nfloat64 z\n"
_TWIST = "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"
_POSE = "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
_NAVSAT_STATUS = (
    "int8 STATUS_NO_FIX=-1\nint8 STATUS_FIX=0\nint8 STATUS_SBAS_FIX=1\nint8 STATUS_GBAS_FIX=2\n"
    "int8 status\n"
    "uint16 SERVICE_GPS=1\nuint16 SERVICE_GLONASS=2\nuint16 SERVICE_COMPASS=4\nuint16 SERVICE_GALILEO=8\n"
    "uint16 service\n"
)
_PARTS = {
    "builtin_interfaces/Time": _TIME,
    "std_msgs/Header": _HEADER,
    "sensor_msgs/NavSatStatus": _NAVSAT_STATUS,
    "geometry_msgs/Vector3": _VECTOR3,
    "geometry_msgs/Point": _VECTOR3,
    "geometry_msgs/Quaternion": _VECTOR3 + "float64 w\n",
    "geometry_msgs/Twist": _TWIST,
    "geometry_msgs/Pose": _POSE,
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
}


def _definition(text: str, *parts: str) -> str:
    sections = [text] + [f"MSG: {name}\n{_PARTS[name]}" for name in parts]
    return f"{_SEPARATOR}\n".join(sections)


_STAMPED = ("std_msgs/Header", "builtin_interfaces/Time")
_TWISTS = ("geometry_msgs/Twist", "geometry_msgs/Vector3")

DEFINITIONS: dict[str, str] = {
    "sensor_msgs/msg/NavSatFix": _definition(
        "uint8 COVARIANCE_TYPE_UNKNOWN=0\nuint8 COVARIANCE_TYPE_KNOWN=3\n"
        "std_msgs/Header header\nsensor_msgs/NavSatStatus status\n"
        "float64 latitude\nfloat64 longitude\nfloat64 altitude\n"
        "float64[9] position_covariance\nuint8 position_covariance_type\n",
        *_STAMPED,
        "sensor_msgs/NavSatStatus",
    ),
    "geometry_msgs/msg/TwistStamped": _definition(
        "std_msgs/Header header\ngeometry_msgs/Twist twist\n", *_STAMPED, *_TWISTS
    ),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _definition(
        "std_msgs/Header header\ngeometry_msgs/TwistWithCovariance twist\n",
        *_STAMPED,
        "geometry_msgs/TwistWithCovariance",
        *_TWISTS,
    ),
    "nav_msgs/msg/Odometry": _definition(
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n",
        *_STAMPED,
        "geometry_msgs/PoseWithCovariance",
        "geometry_msgs/Pose",
        "geometry_msgs/Point",
        "geometry_msgs/Quaternion",
        "geometry_msgs/TwistWithCovariance",
        *_TWISTS,
    ),
}
