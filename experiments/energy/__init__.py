"""What the answers about energy promise: causes, road load, savings, counted on synthetic logs."""

__all__ = []
