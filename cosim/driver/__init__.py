"""Drivers: what belief does to traffic. A driver turns what a vehicle believes into speed commands."""
