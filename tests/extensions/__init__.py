"""One's own choices: each a file that a config names, and not a line of the source touched."""
