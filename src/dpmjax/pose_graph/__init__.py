"""Pose graphs: relative poses in, poses that agree with most of them out."""
