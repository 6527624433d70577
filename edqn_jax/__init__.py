"""E-DQN in one compiled JAX program: a drone learns to fly through unmapped obstacles from events."""
