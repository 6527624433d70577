"""Arrays on disk: parameters of policies and states of runs, each with the checksums of its files."""
