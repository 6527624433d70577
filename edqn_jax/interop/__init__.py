"""Interfaces to other libraries: environments, recordings, ONNX, tracking."""
