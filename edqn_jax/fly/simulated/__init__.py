"""A vehicle and a camera that are not ours, for tests and for those without a drone; and what starts them."""
