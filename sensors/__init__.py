"""Light to belief: what each equipped vehicle's LiDAR returns, and what a detector makes of it."""
