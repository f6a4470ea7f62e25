"""Where the actors of a step come from."""
