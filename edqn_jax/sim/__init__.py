"""The simulator: worlds, drone, camera, events and environment as pure functions; nothing here learns."""
