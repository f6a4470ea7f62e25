"""Ray casters: the nearest surface on every ray of every sensor."""
