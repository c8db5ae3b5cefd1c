"""Readers of depth images."""
