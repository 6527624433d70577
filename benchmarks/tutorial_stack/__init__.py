"""The same task as tutorials write it: one Gymnasium environment a drone, MuJoCo's renderer, NumPy, stable-baselines3.

Nothing here is vectorised by hand; `conventional_stack` is what these packages can do. Nor is there an auto-encoder:
the Q-network of stable-baselines3 reads the event image itself.
"""
