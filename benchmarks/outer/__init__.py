"""The outer test: an exported policy flown through its runner, with pictures, events and flight that are not ours."""
