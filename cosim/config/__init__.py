"""The experiment's config: its sections, its choices by name, and how both are read and checked."""
