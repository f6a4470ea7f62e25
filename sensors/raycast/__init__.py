"""Engines that answer one question: the nearest surface on every ray of every sensor."""
