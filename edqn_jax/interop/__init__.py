"""The task as other libraries want it."""
