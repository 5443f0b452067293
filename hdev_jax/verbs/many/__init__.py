"""Verbs about many vehicles, as commands and as Python functions."""

__all__ = []
