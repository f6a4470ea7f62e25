"""Mistakes in classes of a user's own."""
