"""Sources of traffic: SUMO, its traces, and recorded runs."""
