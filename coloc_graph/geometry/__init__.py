"""Lie groups and trajectories, with numpy alone."""
