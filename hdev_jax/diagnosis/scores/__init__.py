"""Scores of candidates from normal equations by cluster, without a refit."""

__all__ = []
