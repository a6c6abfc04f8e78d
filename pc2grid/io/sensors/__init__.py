"""A cloud, laser scan or depth image -> points in the frame of its sensor, and the scan in the base frame."""
