"""Following a robot from scan to scan: KISS-ICP, wheel odometry, refinement in the plane, health."""
