"""Work on finished runs: sweeps that are computed again, exports, and recordings for a viewer."""
