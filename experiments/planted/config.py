"""The config of the planted study: its cases, and what they share."""

from typing import Literal

from pydantic import Field, model_validator

from experiments.runner.config import Strict
from hdev_jax.diagnosis.settings import described

__all__ = ["Case", "Config"]

Noise = Literal["white", "ar1", "ar1_white", "trip_levels", "student_t", "trip_variance"]
Rival = Literal["stlsq", "lasso_cv", "forward_bic", "lightgbm"]


class Case(Strict):
    """A block of logs: every effect set × size × number of trips × noise, `logs` of each."""

    name: str
    effects: list[list[str]] | str = Field(default_factory=lambda: [[]])  # or the name of one of the config's sets
    parameters: dict[str, dict[str, float]] = Field(default_factory=dict)  # planted as they are: sizes are not asked
    sizes: list[float] = Field(default_factory=lambda: [1.0])
    trips: list[int] = Field(default_factory=lambda: [24])
    noises: list[Noise] = Field(default_factory=lambda: ["ar1"])
    logs: int = 10
    rows_per_trip: int = 250
    entry: Literal["road", "shaft", "wheel"] = "road"
    mode: Literal["segments", "samples"] = "segments"
    held: list[str] = Field(default_factory=list)  # channels of the weather that stay at the trip's mean
    table_sd: dict[str, float] = Field(default_factory=dict)  # how well the sheet knows a coefficient
    # what each log should say: the planted effects by name (nothing, where the library has no name for one of them);
    # that a declared coefficient took them (with none planted: none is far off); that more trips would tell
    asked: Literal["named", "absorbed", "not_decidable"] = "named"
    wanted: float | None = None  # least share of logs with the right answer
    # least share that name exactly what was planted, with no class; of all logs, and of what has no twin by itself
    wanted_alone: float | None = None
    wanted_unexplained: float | None = None  # least share in which something is called unexplained
    wanted_pooled: float | None = None  # least share of right answers over all settings of the case together


class Config(Strict):
    """The study: cases, and what is shared by all of them. `seed` is the first log's; every log has its own."""

    experiment: Literal["planted.study"]
    cases: dict[str, Case]
    only: list[str] = Field(default_factory=list)  # cases to run; all where none is named
    sets: dict[str, list[list[str]]] = Field(default_factory=dict)
    seed: int = Field(1000, ge=0)
    fdr: float = 0.05
    settings: dict[str, int | float] = Field(default_factory=dict)  # of the diagnosis, in place of its defaults

    @model_validator(mode="after")
    def _settings_are_known(self) -> "Config":
        defaults = {s["name"]: s["default"] for s in described()}
        for name, value in self.settings.items():
            if name not in defaults:
                raise ValueError(f"settings.{name}: one of {', '.join(defaults)} is expected")
            if isinstance(defaults[name], int) and not isinstance(value, int):
                raise ValueError(f"settings.{name}: a whole number is expected, found {value!r}")
        return self

    @model_validator(mode="after")
    def _sets_are_there(self) -> "Config":
        for key, case in self.cases.items():
            if isinstance(case.effects, str) and case.effects not in self.sets:
                raise ValueError(
                    f"cases.{key}.effects: one of {', '.join(self.sets)} is expected, found {case.effects!r}"
                )
        return self

    ar_coefficient: float = 0.97
    rivals: list[Rival] = Field(default_factory=list)
