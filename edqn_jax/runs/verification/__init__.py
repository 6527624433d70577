"""A finished run, verified: what its summary must say, from its raw files and by flying again."""
