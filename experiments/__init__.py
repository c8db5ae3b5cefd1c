"""Thin commands: one module for each experiment of the papers and each user task."""
