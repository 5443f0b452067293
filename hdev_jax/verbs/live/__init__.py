"""The verbs of a vehicle on the road: follow."""

__all__ = []
