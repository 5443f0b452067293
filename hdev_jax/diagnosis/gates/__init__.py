"""Gates: what a candidate has to pass before it is named."""

__all__ = []
