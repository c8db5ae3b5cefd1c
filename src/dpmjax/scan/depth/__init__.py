"""Depth images: record, comparison by projection, search and alignment of motions, tracking of a sequence."""
