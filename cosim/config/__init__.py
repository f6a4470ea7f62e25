"""What an experiment states: its sections, choices by name, and how they are read and checked."""
