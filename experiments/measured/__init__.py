"""What the diagnosis finds in measured logs: the runs, their tables, figures and page."""

__all__ = []
