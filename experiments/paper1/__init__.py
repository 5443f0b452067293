"""Paper 1: table 1, figure 5 and the gear study."""

__all__ = []
