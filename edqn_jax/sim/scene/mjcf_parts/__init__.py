"""Parts of reading and writing MJCF."""
