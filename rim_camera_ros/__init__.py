"""Calibrated time-of-flight (range imaging) cameras of the SwissRanger class for ROS 2."""

__version__ = "0.1.0"
