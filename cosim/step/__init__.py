"""One step of the simulation: what vehicles perceive, send, evaluate, trust and fuse."""
