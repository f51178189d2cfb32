"""Keyframe SLAM on touches: composite scans, registration, loop closures, pose graph. No I/O."""
