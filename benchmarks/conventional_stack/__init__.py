"""The conventional stack: C MuJoCo, numba, Gymnasium, PyTorch and stable-baselines3, for the same task.

The implementation that the end-to-end JAX program is compared with, written to be fast. Physics, rays, outcome and
events of all drones of a process run in compiled loops over preallocated arrays, with a few Python calls for each step
of all drones. JAX only generates the missions and the first parameters of the VAE; it is not used in a step.
"""
