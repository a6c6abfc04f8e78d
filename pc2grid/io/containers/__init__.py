"""Files that hold messages, each read as a `MessageSource` of bytes: MCAP, ROS 1 bag, .db3, folders."""
