"""Readers and writers of poses."""
