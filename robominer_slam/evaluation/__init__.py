"""Trajectories and graphs against ground truth: metrics, and the thesis's figures."""
