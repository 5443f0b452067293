"""What remains unexplained, and what it looks like."""

__all__ = []
