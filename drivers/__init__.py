"""From bytes to timed measurements: serial ports, protocols, clocks, recordings. Knows nothing of SLAM."""
