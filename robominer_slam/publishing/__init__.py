"""From the pipeline's results to Zenoh: ROS 2 messages, telemetry, the map stream, the session."""
