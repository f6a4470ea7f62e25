"""Attacks: what attackers and faulty reporters make of their detections and evaluations before they send them."""
