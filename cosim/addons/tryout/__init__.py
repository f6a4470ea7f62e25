"""Tests a user's own class of any kind on a tiny scene, and checks the laws of its interface."""
