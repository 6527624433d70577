"""Random worlds of every family, free points in them and ways through them."""
