"""Baselines of the papers: functions from scans to poses that are no part of the product."""
