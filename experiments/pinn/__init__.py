"""Networks with physics against what they must beat: paper 1, table 2, and the studies around it."""

__all__ = []
