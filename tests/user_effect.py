"""The text of a user's own effect."""

__all__ = ["USER_EFFECT"]

# A user's own effect: what it adds is linear in the time since the start, which nothing in the library is.
USER_EFFECT = '''
from typing import Any, ClassVar

from hdev_jax.physics import Choice, Effect, Shape, Size, Switch


class SlowDrift(Effect):
    """A load that grows with the time since the start."""

    id: ClassVar = "slow_drift"
    stage: ClassVar = "battery"
    equation: ClassVar = "k·t"
    parameters: ClassVar = (Size("w_per_s", "W/s", 0.0, 1.0, 0.0, 100.0),)
    w_per_s: Any

    def power(self, row, car, point):
        return self.w_per_s * row.time_s
'''
