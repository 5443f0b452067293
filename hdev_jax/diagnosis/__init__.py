"""The loop: residual, candidates, evidence, selection, and what is left."""

__all__ = []
