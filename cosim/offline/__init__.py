"""What is made of a run afterwards: sweeps cast again, exports, views."""
