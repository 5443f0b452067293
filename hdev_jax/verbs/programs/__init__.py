"""Verbs that write a vehicle for other programs."""
