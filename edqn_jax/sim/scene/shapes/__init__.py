"""Kinds of shape, a file each; `kind.py` says what the package asks of one."""
