"""What a model of paper 2's tables is: its settings, and the structure that they declare."""

from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from experiments.runner.config import Strict
from hdev_jax.learn import Channels, KernelTerms, Structure

__all__ = ["Settings", "corner_kw", "penalised", "structure"]


class Settings(Strict):
    """One model. What a kind does not read has no effect on it."""

    # what decides a NARX and its loss, the search for its minimum apart
    STRUCTURE: ClassVar = (
        "source", "inputs", "kernel_order", "outputs", "lags", "units", "seen", "linear", "huber_kw", "ridge_size",
        "ridge_slope",
    )  # fmt: skip
    # the same of a recurrent network
    TRAINING: ClassVar = ("kind", "cell", "inputs", "units", "length", "rate", "decay", "huber_kw")

    kind: Literal["narx", "recurrent", "classical", "diagnosed", "persistence"]
    why: str = ""  # what the row is, for the table
    # which of several starts is the model: that of least loss on the training trip, or the mean of all
    rule: Literal["least", "ensemble"] = "least"
    source: Literal["channels", "kernel"] = "channels"
    inputs: list[str] = Field(default_factory=lambda: ["motor_torque_nm", "speed_mps"])
    kernel_order: Literal[1, 2] = 2
    outputs: int = Field(3, ge=0)
    lags: list[int] = Field(default_factory=lambda: [0, 1, 2], min_length=1)
    units: int = Field(5, ge=0)
    seen: Literal["inputs", "all"] = "inputs"
    linear: bool = True
    huber_kw: float = Field(0.4, ge=0)  # corner of Huber's loss; 0: squares
    ridge_size: float = Field(1e-6, ge=0)
    ridge_slope: float = Field(1e-3, ge=0)
    starts: int = Field(16, ge=1)
    steps: int = Field(120, ge=1)
    coarse_steps: int = Field(50, ge=1)
    rtol: float = Field(1e-5, ge=0)
    simulation: bool = False
    simulation_steps: int = Field(30, ge=1)
    cell: Literal["lstm", "gru"] = "lstm"
    length: int = Field(128, ge=1)
    rate: float = Field(0.02, gt=0)
    decay: float = Field(0.03, ge=0)
    model: Literal["tree", "boosted", "robust_linear", "support_vectors"] = "tree"
    trials: int = Field(12, ge=1)

    @model_validator(mode="after")
    def _cells_have_units(self) -> Self:
        if self.kind == "recurrent" and not self.units:
            raise ValueError("units: a recurrent network has at least one")
        return self

    @property
    def choices(self) -> tuple[str, ...]:
        """The keys of what can be chosen of a model by rows left out."""
        return self.TRAINING if self.kind == "recurrent" else self.STRUCTURE

    def chosen(self) -> dict[str, Any]:
        """What can be chosen of a model by rows left out."""
        return self.model_dump(mode="json", include=set(self.choices))

    def task(self) -> dict[str, Any]:
        """Plain values for a task: all that decides the model."""
        return self.model_dump(mode="json", exclude={"why"})


def corner_kw(s: dict[str, Any]) -> float:
    """Corner of Huber's loss in kW; infinite where a model's settings ask for squares."""
    return s["huber_kw"] or np.inf


def penalised(s: dict[str, Any]) -> dict[str, Any]:
    """Loss and ridge of a NARX, as the fits take them."""
    return {"huber": corner_kw(s), "ridge": {"size": s["ridge_size"], "slope": s["ridge_slope"]}}


def structure(s: dict[str, Any]) -> Structure:
    """Orders and units of a model's settings."""
    source = KernelTerms(s["kernel_order"]) if s["source"] == "kernel" else Channels(tuple(s["inputs"]))
    return Structure(source, s["outputs"], tuple(s["lags"]), s["units"], s["seen"], s["linear"])
