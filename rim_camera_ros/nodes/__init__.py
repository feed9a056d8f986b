"""ROS 2 nodes: thin shells around devices and pipeline; the only place that imports rclpy."""
