"""How long encounters and the times between them last: samples with censoring, families of distributions, facts."""
