"""Traffic, chance, messages, the cycle, and the commands that run it all."""
