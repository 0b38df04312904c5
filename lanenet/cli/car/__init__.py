"""Verbs that run on the car: drive, doctor, bench and what belongs to them."""
