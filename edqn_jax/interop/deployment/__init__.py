"""A policy on another computer: its export as ONNX, and what flies it without JAX."""
