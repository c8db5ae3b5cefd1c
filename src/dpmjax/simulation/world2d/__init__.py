"""Planar worlds and walks through them."""
