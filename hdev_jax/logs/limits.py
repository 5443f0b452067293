"""What a road vehicle's log may hold: beyond, a value is broken, in another unit, or no drive."""

__all__ = [
    "BAD_SHARE",
    "CHARGES_W",
    "GAP_SAMPLES",
    "MANY_STEEP",
    "MAX_GRADE_RAD",
    "MAX_POWER_W",
    "MAX_SPEED_MPS",
    "REVERSE_MPS",
    "STANDS_MPS",
]

MAX_SPEED_MPS = 60.0  # contract §1: above, the column is in km/h or broken
REVERSE_MPS = 0.5  # contract §1: down to −0.5 m/s a sensor's undershoot, set to 0
MAX_GRADE_RAD = 0.8  # beyond 45°, which is more than tyres hold; the steepest street has 35 %, test tracks 60 %
MANY_STEEP = 0.1  # of the slopes driven: no instrument's faults, but another unit
MAX_POWER_W = 2e7  # no road vehicle draws it: the largest mining trucks have under 4 MW
# Bad rows in needed columns, at most: loggers of the public data sets lose 0.1 to 3 %; at 10 % what remains has holes
# that no neighbour bridges.
BAD_SHARE = 0.05
GAP_SAMPLES = 10.0  # contract §1: a gap longer than ten samples starts a new trip
STANDS_MPS = 0.1  # instruments at rest show a little
# Into the battery: the slowest charger (6 A, one phase, IEC 61851-1) gives 1.4 kW; a sensor's zero is off by less.
CHARGES_W = -1000.0
