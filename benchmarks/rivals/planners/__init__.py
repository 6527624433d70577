"""Planners that know the map, and a follower that flies their paths; one module each."""
