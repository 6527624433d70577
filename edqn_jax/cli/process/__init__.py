"""The process of a command: signals, output, its status, arguments that do not parse, environment variables."""
