"""The methods that `runtime.py` compares: how each is run, and the tables and the picture of the results."""
