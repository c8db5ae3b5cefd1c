"""Simulated buildings for a lidar that is carried: rooms, corridors and halls by seed, and walks through them."""
