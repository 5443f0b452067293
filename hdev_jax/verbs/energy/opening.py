"""How the verbs about energy begin: log and sheet together, the vehicle fitted, the run's folder."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax

from hdev_jax import progress
from hdev_jax.diagnosis.candidates.own import Effects, known_effects, tried
from hdev_jax.energy.fitted import Fitted, calibrated_on
from hdev_jax.errors import InputError
from hdev_jax.inference import Spread
from hdev_jax.inference.sheet import Sheet
from hdev_jax.logs import Log
from hdev_jax.problem import Problem, implausible, prepare
from hdev_jax.rundir import open_run
from hdev_jax.targets import TARGETS
from hdev_jax.textfiles import digest
from hdev_jax.verbs.arguments import seed_of
from hdev_jax.verbs.beside import beside_sheet, covariance_of
from hdev_jax.verbs.energy.result import EnergyResult
from hdev_jax.verbs.opening import Logs, Vehicles, digest_of_effects, digest_of_vehicle, log_of, named, sheet_of
from hdev_jax.verbs.result import PREDICTIVE, Result
from hdev_jax.verbs.states import given_states

__all__ = ["Asked", "answered", "battery_target", "fitted_for", "problem_for", "synthetic", "trusted"]

KNOWN = 200.0  # degrees of freedom of a table's sd: as good as a normal


@dataclass
class Asked:
    """What a verb was asked: the log read, sheets by path as given, and its options, for the run's configuration."""

    verb: str
    logs: Logs
    log: Log
    adapter: str | Path | None
    effects: Effects
    seed: int
    options: dict[str, Any]
    positional: tuple[str, ...] = ()
    sheets: dict[str, tuple[Vehicles, Sheet]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, verb: str, logs: Logs, adapter: str | Path | None, effects: Effects, seed: int, options: dict[str, Any],
        positional: tuple[str, ...] = (),
    ) -> "Asked":  # fmt: skip
        """Read the log. Raises `InputError`."""
        with progress.busy("reading the logs"):
            log = log_of(logs, adapter)
        return cls(verb, logs, log, adapter, effects, seed_of(seed), options, positional)

    def sheet(self, vehicle: Vehicles, name: str = "vehicle") -> Sheet:
        """Read a sheet. Raises `InputError`."""
        sheet = sheet_of(vehicle, known_effects(self.effects))
        self.sheets[name] = (vehicle, sheet)
        return sheet

    def config(self, kept: bool) -> dict[str, Any]:
        """Everything that decides the result."""
        logs = self.logs if isinstance(self.logs, list | tuple) else [self.logs]
        sheets = {}
        for name, (vehicle, sheet) in self.sheets.items():
            sheets |= {name: named(vehicle), f"{name}_sha256": digest_of_vehicle(vehicle, sheet)}
            if isinstance(vehicle, str | Path):
                sheets[f"{name}_beside_sha256"] = digest(Path(vehicle).parent / PREDICTIVE)
        return {
            "verb": self.verb, "logs": [named(p) for p in logs], "log_sha256": self.log.fingerprint(), **sheets,
            "adapter": None if self.adapter is None else str(self.adapter),
            "effects_file": None if self.effects is None else named(self.effects),
            "effects_sha256": digest_of_effects(self.effects) if kept else None,
            "seed": self.seed, "of": list(self.positional), **self.options,
            "x64": bool(jax.config.read("jax_enable_x64")),
        }  # fmt: skip

    def command(self, out: str | Path | None) -> str:
        """The command that makes this again; the function, where there is no folder."""
        if out is None:
            return f"hdev_jax.{self.verb}(…)"
        logs = [named(p) for p in (self.logs if isinstance(self.logs, list | tuple) else [self.logs])]
        parts = ["hdev", self.verb, *self.positional, *(["--log"] if self.verb == "compare" else []), *logs]
        if "vehicle" in self.sheets and self.verb != "whatif":
            parts += ["--vehicle", named(self.sheets["vehicle"][0])]
        given = {
            "adapter": self.adapter,
            "effects": None if self.effects is None else named(self.effects),
            **self.options,
        }
        for option, value in given.items():
            for each in (
                value if isinstance(value, list | tuple) else [] if value is None or value is False else [value]
            ):
                parts += [f"--{option.replace('_', '-')}", *([] if each is True else [str(each)])]
        return shlex.join([*parts, "--seed", str(self.seed), "--out", str(out)])


def battery_target(log: Log, target: str | None) -> str:
    """The battery's target that the log measures. Raises `InputError` where it measures none, or another is asked."""
    if target is not None and (target not in TARGETS or not TARGETS[target].of_battery):
        able = ", ".join(t.name for t in TARGETS.values() if t.of_battery)
        raise InputError(f"--target {target}: this command is about energy at the battery; accepted: {able}")
    if target is None and not log.measured:
        raise InputError(
            "the log measures no energy or power at the battery (energy_wh, battery_power_w, battery_power_kw), which "
            "this command needs; hdev check shows what was read"
        )
    return target or log.default_target


def problem_for(
    asked: Asked, vehicle: Vehicles, target: str, *, name: str = "vehicle", measured: bool = True
) -> Problem:
    """Log, sheet and target together. Raises `InputError`."""
    problem = prepare(asked.log, asked.sheet(vehicle, name), target, need_measured=measured)
    tried(problem, known_effects(asked.effects), asked.effects)
    return problem


def trusted(problem: Problem, trust: bool) -> None:
    """Raise `InputError`, one line, where what the log measures cannot be right for this vehicle; nothing with `trust`.

    An answer in kWh or percent would be that of the fault.
    """
    if not trust and (found := implausible(problem)):
        lines = "; ".join(s.line() for s in found)
        raise InputError(f"the log is suspect: {lines} (--trust computes the answer anyway)")


def fitted_for(problem: Problem, vehicle: Vehicles, *, calibrate: bool = True) -> Fitted:
    """The vehicle with what is open: as a fit before left it beside the sheet, else calibrated on this log; by its sds
    alone where the log is not to `calibrate` it. Loads that switch are where the measured power shows them."""
    known, stale = _known(problem, vehicle)
    notes = list(problem.notes)
    if stale:
        notes.append("predictive.json beside the sheet is not used: the sheet was changed after it was written")
    if not known and calibrate:
        progress.step("calibrating")
        fitted = calibrated_on(problem)
        return replace(fitted, notes=(*fitted.notes, *notes[len(problem.notes) :]))
    spread = Spread(**known["spread"]) if known else None
    how = "as fitted before (predictive.json beside the sheet)" if known else "the sheet's values, with its sds"
    if calibrate and (given := given_states(problem, known)) is not None:
        problem = given
        notes.append(
            "loads that switch are decoded from the measured power; the intervals leave out errors of the decoding"
        )
    covariance = covariance_of(problem, known)
    freedom = max(spread.total_freedom, 2.0) if spread else KNOWN
    return Fitted(problem, problem.vehicle, covariance, freedom, spread, how, tuple(notes))


def _known(problem: Problem, vehicle: Vehicles) -> tuple[Mapping[str, Any], bool]:
    beside = vehicle.predictive if isinstance(vehicle, Result) else {}
    if isinstance(vehicle, str | Path):
        beside = beside_sheet(Path(vehicle))
    usable = bool(beside) and not beside.get("stale") and beside.get("target") == problem.target
    return (beside if usable else {}), bool(beside.get("stale"))


def answered(asked: Asked, out: str | Path | None, work: Callable[[str], EnergyResult]) -> EnergyResult:
    """The answer in memory, or kept in the folder `out`; `work` takes the command for the page."""
    if out is None:
        return work(asked.command(None))
    with open_run(out, asked.config(True), seed=asked.seed) as run:
        if run.done:
            return EnergyResult.of_folder(asked.verb, run.work)
        result = work(asked.command(out))
        progress.step("writing the report")
        result.write(run, out)
    return result


def synthetic(log: Log, names: Sequence[str]) -> bool:
    """Whether a name says that the data are made up."""
    return "synthetic" in " ".join([*names, *log.files, *log.vehicle_names]).lower()
