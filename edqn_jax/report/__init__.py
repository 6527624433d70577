"""Pictures and tables for people, drawn from a run directory."""
