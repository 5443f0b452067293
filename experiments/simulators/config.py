"""The config of the study with simulators: which vehicles, changes and logs."""

from typing import Literal

from pydantic import Field, model_validator

from experiments.runner.config import Strict
from experiments.simulators.plants import PLANTS

__all__ = ["Config", "Line"]

Rival = Literal["stlsq", "lasso_cv", "lightgbm"]


class Line(Strict):
    """Logs of one simulator, written in one way: each vehicle × change, `logs` of each."""

    simulator: Literal["fastsim", "sumo"]
    vehicles: list[str]
    plants: list[str]
    rows: Literal["intervals", "samples", "segments"] = "intervals"
    measured: Literal["none", "force", "torque"] = "none"
    logs: int = Field(1, ge=0)

    @model_validator(mode="after")
    def _seen(self) -> "Line":
        for plant in self.plants:
            if plant not in PLANTS:
                raise ValueError(f"plants: one of {', '.join(PLANTS)} is expected, found {plant!r}")
            if self.measured not in PLANTS[plant].seen_by:
                raise ValueError(f"plants: {plant} changes nothing where {self.measured} is measured; leave it out")
        if self.measured == "torque" and (self.simulator == "sumo" or self.rows == "segments"):
            raise ValueError("measured: torque comes from FASTSim and second by second alone")
        return self


class Config(Strict):
    """The study. A seed draws a vehicle, its trips and the noise; every log has its own."""

    experiment: Literal["simulators.study"]
    lines: dict[str, Line]
    seed: int = Field(1000, ge=0)
    trips: int = Field(18, ge=6)
    seconds: float = Field(600.0, gt=60.0)  # of a trip, ± 20 %
    noise: float = Field(0.02, gt=0.0)  # RMS over that of the power
    ar_coefficient: float = 0.9
    fdr: float = 0.05
    rivals: list[Rival] = Field(default_factory=list)
    # shares that are wanted, of logs with nothing changed and with one change
    wanted_right: float = 0.85
    wanted_false: float = 0.05  # at most, of logs with nothing changed
    wanted_beside: float = 0.10  # at most, of logs with one change: a false name beside it
    wanted_covered: float = 0.80
    wanted_error: float = 1.10  # at most, held-out error over that of a refit that knows the cause
