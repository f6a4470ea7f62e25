"""Tracking: what each vehicle remembers of an object from one sweep to the next."""
