"""Worlds and flights through them, drawn for people."""
