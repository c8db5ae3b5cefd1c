"""Maps of planar scans: sequences, loops, joint refinement, and the trust in a map."""
