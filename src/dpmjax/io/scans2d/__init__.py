"""Readers of planar scans."""
