"""The verbs that write a vehicle for other programs: export."""

__all__ = []
