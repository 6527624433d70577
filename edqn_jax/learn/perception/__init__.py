"""What the encoder learns: event VAE, its encoders, and what the Q-network sees of each sensor."""
