"""People who walk through the view of a resting camera; no ROS in here.

The chain of T. Kahlmann, *Range Imaging Metrology* (ETH Zurich, 2007), sec. 1.1.1: what moves is told from
the background by distance, moving points are clustered, and clusters become positions. A filter for each
person is added, so that identities outlive an occlusion.
"""
