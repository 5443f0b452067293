"""Pages of runs: one file that opens offline, and Markdown for the site."""

__all__ = []
