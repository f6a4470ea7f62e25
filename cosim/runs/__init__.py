"""How a run is driven, recorded, checkpointed and resumed."""
