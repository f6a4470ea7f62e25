"""Drivers: reactions to fused objects. A driver turns the objects that a vehicle believes in into speed commands."""
