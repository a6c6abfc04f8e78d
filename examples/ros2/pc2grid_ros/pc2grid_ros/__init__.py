"""pc2grid as a node of ROS 2."""
