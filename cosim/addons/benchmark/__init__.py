"""The benchmark of trust models: recorded evidence, a score of any model on it, and an adversary that adapts."""
