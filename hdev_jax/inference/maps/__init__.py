"""Efficiency maps: read from a table, learned from a log, and how a log lies to them."""

__all__ = []
