"""Pictures, events and dynamics that are not ours, of the outer test and of simulated flights over the wire."""
