"""The calibration node, and the processes in which it records and calibrates."""
