"""Files in and out: recordings, maps, trajectories. Submaps are unknown here.

`recording.open_log` is the way in for recordings. A recording passes through the folders in this order:

    containers/  files and folders -> timed messages of bytes (`source.MessageSource`)
    messages/    bytes of a ROS or Foxglove message -> one of our few message types
    sensors/     a message of a lidar, laser or camera -> points

`recording` puts them together. `plan` decides from the first messages what to read: the sensors and the
topics of the same robot (by `topics`), the base and tf (`frames`), the odometry and the IMU.
`stream` yields the scans in order. A running robot is followed by live/. Results are written by `export`,
`maps` and `trajectory`, all through `atomic`.
"""
