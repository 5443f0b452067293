"""Candidates: the columns that each effect of the library would add to every row."""

__all__ = []
