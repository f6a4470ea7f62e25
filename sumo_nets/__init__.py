"""Street networks for SUMO: the shipped cities, how to build them, and how to read a user's own."""
