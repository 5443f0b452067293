"""The physics-informed network of paper 1."""

__all__ = []
