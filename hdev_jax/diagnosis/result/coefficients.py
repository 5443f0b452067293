"""Declared coefficients in diagnosis.json: value, table, what each may stand for."""

from collections.abc import Mapping, Sequence
from typing import Any

from hdev_jax.diagnosis.competition.state import State
from hdev_jax.diagnosis.gates.rejection import Kind
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.inference import Calibration

__all__ = ["as_they_end", "baseline_block", "far"]


def baseline_block(fit: Calibration, absorbs: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """The contract's `baseline.parameters`: value, sd, prior, distance from the prior, what it may have absorbed."""
    block = {}
    for c, value, sd, z in zip(fit.table.free, fit.values, fit.sd, fit.prior_z(), strict=True):
        prior = {} if c.sd is None else {"prior_value": c.value, "prior_sd": c.sd, "prior_z": float(z)}
        block[c.name] = {
            "value": float(value), "sd": float(sd), "unit": c.unit, **prior, "absorbs": list(absorbs.get(c.name, ())),
        }  # fmt: skip
    return block


def as_they_end(fit: Calibration, state: State, settings: Settings) -> dict[str, Any]:
    """The declared coefficients of the model with the effects, as in `baseline.parameters`; `absorbs` of one that is
    far from its table are the effects that it may stand for: those of plausible sizes, the best first."""
    declared = {k: v for k, v in baseline_block(fit, {}).items() if not k.startswith("effects.")}
    if not state.found:  # what was searched is another model then
        return {k: {**b, "absorbs": state.absorbs.get(k, []) if far(b, settings) else []} for k, b in declared.items()}
    able = [v for v in state.verdicts if v.rejection.kind is Kind.ABSORBED and v.rejection.numbers.get("plausible")]
    able.sort(key=lambda v: -(v.score or 0.0))
    for name, block in declared.items():
        if far(block, settings):
            block["absorbs"] = [v.id for v in able if v.rejection.numbers["by"] == name]
    return declared


def far(block: Mapping[str, Any], settings: Settings) -> bool:
    """Whether a coefficient is far from its table."""
    return abs(block.get("prior_z", 0.0)) > settings.far
