"""Tries a class of the user's own, of any kind, on a tiny scene, and checks the laws of its interface."""
