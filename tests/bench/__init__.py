"""Speed of every component on this machine."""
