"""The learner: event VAE, Q-network, replay, DQN and the one scanned training step; no physics, no pixels."""
