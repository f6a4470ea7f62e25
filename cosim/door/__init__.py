"""A user's own classes: the kinds of choices, checked loading, and an adapter that checks every call."""
