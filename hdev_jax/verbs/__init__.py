"""The verbs: what `hdev VERB` does, each as a Python function of the same name and arguments."""

__all__ = []
