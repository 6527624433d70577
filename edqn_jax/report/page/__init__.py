"""The page of runs: one HTML file with their worlds, flights, curves and options that needs nothing else."""
