"""Bytes of ROS 1, ROS 2 and Foxglove messages and of files of clouds -> the message types of `types`."""
