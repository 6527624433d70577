"""The process of a command: signals, output that cannot be written, environment variables."""
