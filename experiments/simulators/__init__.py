"""Truth from simulators that were not written here: FASTSim and SUMO drive, the diagnosis names what was changed."""

__all__ = []
