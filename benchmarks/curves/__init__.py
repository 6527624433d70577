"""The curves of `scaling.py`: what is varied, how many bytes training takes, and the picture."""
