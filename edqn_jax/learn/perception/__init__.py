"""Perception: event VAE, its encoders, and the embedding of each sensor for the Q-network."""
