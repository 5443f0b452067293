"""Posteriors by sampling: the probabilistic model, NUTS, exact draws, and how well they were made."""

__all__ = []
