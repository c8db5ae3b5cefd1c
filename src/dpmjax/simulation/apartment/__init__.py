"""Simulated apartments seen by a depth camera."""
