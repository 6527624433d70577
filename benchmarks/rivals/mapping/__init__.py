"""A map that grows in flight, from depth and the own pose, and a pilot that plans on it and is given no other."""
