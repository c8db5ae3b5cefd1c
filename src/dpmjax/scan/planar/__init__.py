"""Planar scans: record, views, search, alignment and slides of pairs."""
