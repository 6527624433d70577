"""Run directories, saved policies, provenance, files written atomically."""
