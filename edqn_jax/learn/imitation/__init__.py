"""Imitation of a policy that sees depth by one that sees what it will have in flight (DAgger, Ross et al. 2011)."""
