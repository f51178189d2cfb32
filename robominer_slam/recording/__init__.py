"""Recordings of a running robot: its raw sensors, or what came over the link."""
