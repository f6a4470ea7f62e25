"""Belief to trust: TruPercept as functions of arrays and params; no geometry, no chance, no names of truth."""
