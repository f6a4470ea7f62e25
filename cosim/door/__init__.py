"""A user's own classes: the kinds of choices, loading with checks, and an adapter that checks every call."""
