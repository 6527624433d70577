"""The deep Q-network of the paper (section 3.3, Algorithm 1): replay, target network, Eq. 7-10."""
