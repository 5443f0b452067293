"""Thin runs: each is a config away from a table or a figure. `python -m experiments CONFIG --out DIR`."""

__all__ = []
