"""Readers of 3-D lidar drives."""
