"""Co-simulation of traffic, LiDAR, V2X messages and trust at city scale."""

__version__ = "0.3.0.dev0"
