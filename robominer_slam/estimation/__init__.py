"""Dead reckoning: from IMU, screws or a ready-made odometry to the robot's pose in `odom`."""
