"""The host loop around compiled chunks, the choice of parameters, and what a run records."""
