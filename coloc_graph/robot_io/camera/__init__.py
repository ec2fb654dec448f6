"""Cameras: V4L2, video files, and a simulated world."""
