"""Where the loss of accuracy sits: the road's residual and the machine's, apart, where the chain is measured between.

With force or torque measured and a sheet that declares the road too, a log holds two problems: from the road to the
force at the wheels, and from there to the battery. Each has its own suspects, and each is diagnosed by itself.
"""

from collections.abc import Callable, Mapping
from typing import Any

from hdev_jax.diagnosis.diagnose import Outcome, diagnose
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.errors import InputError
from hdev_jax.physics import Effect
from hdev_jax.problem import prepare
from hdev_jax.targets import TARGETS

__all__ = ["add_stages"]


def add_stages(
    result: Outcome,
    library: Mapping[str, type[Effect]],
    *,
    settings: Settings,
    seed: int,
    tell: Callable[[str], None] = lambda _: None,
    checkpoint: Callable[[str, Callable[[], Any]], Any] = lambda _, compute: compute(),
) -> None:
    """Add `stages` to a diagnosis of the battery's side, and a note on what the road's side lacks.

    Nothing is added where the chain is entered at the road, or the sheet does not declare it.
    """
    problem, split, summary = result.problem, result.split, result.summary
    declares = any(name.startswith("road.c_rr") for name in problem.sheet.declared)
    if problem.vehicle.entry == "road" or not declares or not TARGETS[problem.target].of_battery:
        return
    try:
        road = prepare(split.log, problem.sheet, "traction_force_n")
    except InputError as e:
        summary["notes"].append(f"the road stage is not diagnosed separately: {e}")
        return
    tell("the road's side: from the sheet to the force that was measured")
    other = diagnose(
        road,
        split,
        library,
        settings=settings,
        seed=seed,
        next_drives=False,
        tell=tell,
        checkpoint=lambda n, f: checkpoint(f"road-{n}", f),
    )  # fmt: skip
    summary["stages"] = {
        "road": {
            **{k: other.summary[k]["test"] for k in ("before", "after")}, "unit": road.unit,
            "effects": [e["id"] for e in other.summary["effects"]],
        },
        "machine": {
            **{k: summary[k]["test"] for k in ("before", "after")}, "unit": problem.unit,
            "effects": [e["id"] for e in summary["effects"]],
        },
    }  # fmt: skip
    rmse = [other.summary[k]["test"]["rmse"] for k in ("before", "after")]
    found = ", ".join(summary["stages"]["road"]["effects"]) or "nothing that could be named"
    summary["notes"].append(
        f"between the road and the wheels the declared model misses {found}: test RMSE {rmse[0]:.4g} to {rmse[1]:.4g} "
        f"{road.unit}; the error above does not include it, since the force is measured"
    )
