"""The autopilot: from a camera's events to setpoints on the wire. Nothing here needs JAX while it flies."""
