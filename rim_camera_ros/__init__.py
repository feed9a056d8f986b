"""Calibrated time-of-flight (range imaging) cameras of the SwissRanger class for ROS 2."""

from rim_camera_ros.interruption import end_quietly_while_importing

__version__ = "0.1.0"

end_quietly_while_importing()
