"""The study of planted effects: synthetic logs with known truth, and rivals on the same logs."""

__all__ = []
