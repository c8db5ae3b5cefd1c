"""Lidar scans: preparation, record, surfaces and free space, and the motion between two."""
