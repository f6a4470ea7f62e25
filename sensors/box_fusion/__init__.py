"""Boxes of objects that several vehicles detected, by the accuracy that each vehicle states."""
