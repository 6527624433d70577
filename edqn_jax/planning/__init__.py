"""Shortest paths through known worlds: what missions, the reward and SPL need."""
