"""Synthetic fleets of measured vehicles: what only a fleet can tell, is it true?"""

__all__ = []
