"""The radio channel: propagation, PHY, medium access and rounds of messages between stations."""
