"""Truth from simulators that were not written here: FASTSim and SUMO drive, one of their parameters is changed, the
diagnosis names it."""
