"""Saved maps in the formats that other programs read."""
