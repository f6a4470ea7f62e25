"""Code for speed and memory only. It changes no result."""
