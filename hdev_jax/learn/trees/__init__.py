"""Boosted trees as arrays, evaluated within jit."""

__all__ = []
