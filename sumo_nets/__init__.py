"""Street networks for SUMO: read the shipped cities, build others, and read a user's own network."""
