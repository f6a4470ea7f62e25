"""Predicts what a study would measure, from traffic alone: no sweep is cast, no message sent, no trust computed."""
