"""The conventional stack: C MuJoCo, numba, Gymnasium, PyTorch and stable-baselines3, for the same task.

What the end-to-end JAX design has to beat, so written to be fast. Physics, rays, outcome and events of all drones
of a process run in compiled loops over preallocated arrays; Python is entered a few times for each step of all of
them. JAX has no part in a step: it lays out the missions beforehand, and no more.
"""
