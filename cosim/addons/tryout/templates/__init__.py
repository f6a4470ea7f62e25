"""A small working example of every kind of extension: what `cosim new` writes."""
