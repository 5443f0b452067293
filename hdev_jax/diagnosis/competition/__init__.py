"""The competition: candidates are added, taken out and exchanged until nothing changes."""

__all__ = []
