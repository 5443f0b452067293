"""The gear as a surrogate: features, classifiers, the channel that the kernel reads."""

__all__ = []
