"""The axes of `worth.py`: their rows, what only they see and fly, and the map."""
