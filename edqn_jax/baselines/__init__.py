"""Rivals and references, one file each, each runnable alone."""
