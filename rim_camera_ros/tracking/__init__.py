"""People who walk through the view of a resting camera; no ROS in here.

The steps are those of T. Kahlmann, *Range Imaging Metrology* (ETH Zurich, 2007), sec. 1.1.1: moving pixels
are distinguished from the background by their distance, moving points are clustered, and clusters become
positions. A filter for each person is added, so that identities are kept through an occlusion.
"""
