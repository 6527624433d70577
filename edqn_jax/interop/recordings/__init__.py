"""Recorded events, the files that hold them, and how a policy sees them."""
