"""The simulated robot: same serial protocols as the hardware. Only its commands and the tests use it."""
