"""What the verbs return: the answer as text, numbers, frames and figures; in memory, or read from a folder."""

import json
import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from hdev_jax.checkpoints import load, packed
from hdev_jax.errors import InputError
from hdev_jax.report.data import ReportData
from hdev_jax.rundir import Run
from hdev_jax.targets import TARGETS

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from hdev_jax.inference.posterior.draws import Draws

__all__ = ["PREDICTIVE", "CalibrationResult", "Diagnosis", "Prediction", "Result"]

R = TypeVar("R", bound="Result")
ANSWER, PREDICTIVE = "answer.txt", "predictive.json"
DATA = "data.npz"  # rows and channels that a report is made of


def _kept(folder: Path) -> ReportData:
    """The report's data of a finished folder. Raises `InputError` where it is not there, or is damaged."""
    try:
        return ReportData(**load(folder / DATA))
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise InputError(f"{folder / DATA}: cannot be read ({e}); run the command again into a new folder") from e


class Result(ABC):
    """An answer and the numbers behind it. `str()` is the answer as the command line prints it.

    - `summary`: what the JSON file of the command holds (contract, section 4).
    - `sheet`: the vehicle sheet as fitted, TOML.
    - `predictive`: what `predictive.json` holds, the covariance and noise for the intervals of `hdev_jax.predict`.
    - `data`: the rows, channels and errors that the report shows; read from the run's folder on first use.
    """

    json_file: ClassVar[str]
    sheet_file: ClassVar[str]

    def __init__(
        self, answer: str, summary: Mapping[str, Any], sheet: str, predictive: Mapping[str, Any],
        data: ReportData | Callable[[], ReportData],
    ):  # fmt: skip
        self.summary: dict[str, Any] = dict(summary)
        self.sheet: str = sheet
        self.predictive: dict[str, Any] = dict(predictive)
        self._answer, self._data = answer, data

    @classmethod
    def of_folder(cls: type[R], folder: Path) -> R:
        """The result in a finished folder; `data` is read on first use."""
        summary, predictive = (json.loads((folder / name).read_text()) for name in (cls.json_file, PREDICTIVE))
        answer, sheet = ((folder / name).read_text() for name in (ANSWER, cls.sheet_file))
        return cls(answer, summary, sheet, predictive, partial(_kept, folder))

    def write(self, run: Run, out: str | Path) -> None:
        """Write all files of the result into the folder of `run`, channels in single precision.

        `out`: the folder's name for the user.
        """
        run.path(self.sheet_file).write_text(self.sheet)
        for name, content in ((PREDICTIVE, self.predictive), (self.json_file, self.summary)):
            run.path(name).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
        self._write_report(run.work)
        channels = {k: np.asarray(v, dtype=np.float32) for k, v in self.data.channels.items()}
        with open(run.path(DATA), "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **packed({**vars(self.data), "channels": channels}))
        self._answer = f"{self._answer}\n{Path(out) / 'report.html'}"
        run.path(ANSWER).write_text(self._answer)

    @property
    def _unit(self) -> str:
        return TARGETS[self.summary["target"]].unit

    @cached_property
    def data(self) -> ReportData:
        """Rows, channels and errors that the report shows."""
        return self._data if isinstance(self._data, ReportData) else self._data()

    def __str__(self) -> str:
        return self._answer

    def _repr_html_(self) -> str:
        from html import escape

        return f"<pre>{escape(self._answer)}</pre>"

    @property
    def before(self) -> dict[str, Any]:
        """Errors of the declared model on the held-out test trips: `rmse`, `mse`, `bias`, `pe_percent`, `n`."""
        return self.summary["before"]["test"]

    @property
    def residual(self) -> "pd.DataFrame":
        """One row for each row of the log, in the target's unit: `trip_id`, `time_s`, `measured`, `before`, `after`,
        `residual_before`, `residual_after` (measured − predicted), `test`."""
        import pandas as pd

        d = self.data
        names = np.asarray(d.trip_names, dtype=object)
        columns = {k: d.row(k) for k in ("time_s", "measured", "before", "after")}
        residuals = {f"residual_{k}": d.residual(k) for k in ("before", "after")}
        return pd.DataFrame({"trip_id": names[d.row("trip")], **columns, **residuals, "test": d.row("test")})

    def report(self, path: str | Path) -> Path:
        """Write the report: one page where `path` ends in .html, else a folder with `report.html` and `figures/`.

        **Returns:** the page's path.
        """
        path = Path(path)
        if path.suffix not in (".html", ".htm"):
            self._write_report(path)
            return path / "report.html"
        with tempfile.TemporaryDirectory() as folder:
            self._write_report(Path(folder))
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(Path(folder) / "report.html", path)
        return path

    @abstractmethod
    def _write_report(self, folder: Path) -> None: ...

    def plot_coefficients(self) -> "Figure | None":
        """The coefficients beside their tabular values; None where no coefficient was estimated."""
        from hdev_jax.report.figures import coefficients

        return self._drawn(coefficients)

    def plot_trips(self) -> "Figure | None":
        """Error of each trip."""
        from hdev_jax.report.figures import trip_errors

        return self._drawn(trip_errors)

    def _drawn(self, figure: Callable[[ReportData], Any]) -> Any:
        from hdev_jax.report.canvas import style

        with style():
            return figure(self.data)


class Diagnosis(Result):
    """The effects that a model lacked, with their sizes, and the error before and after on held-out test trips."""

    json_file = "diagnosis.json"
    sheet_file = "augmented_vehicle.toml"

    def __repr__(self) -> str:
        unit, found = self._unit, ", ".join(e["id"] for e in self.summary["effects"]) or "no effect"
        return f"Diagnosis({found}; test RMSE {self.before['rmse']:.4g} -> {self.after['rmse']:.4g} {unit})"

    @property
    def effects(self) -> "pd.DataFrame":
        """One row for each parameter of each effect found, in the order of finding: `effect`, `parameter`, `value`,
        `sd`, `low`, `high` (90 %), `unit`, `q_value`, `stability`, `indistinguishable_from`, `rmse_after`."""
        import pandas as pd

        columns = ["effect", "parameter", "value", "sd", "low", "high", "unit", "q_value", "stability",
                   "indistinguishable_from", "rmse_after"]  # fmt: skip
        rows = []
        for e in self.summary["effects"]:
            for name, p in e["parameters"].items():
                low, high = p.get("interval_90", (None, None))
                rows.append([e["id"], name, p["value"], p["sd"], low, high, p["unit"], e["q_value"], e["stability"],
                             ", ".join(e["indistinguishable_from"]), e["test_rmse_after"]])  # fmt: skip
        return pd.DataFrame(rows, columns=columns)

    @property
    def after(self) -> dict[str, Any]:
        """Errors of the model with the effects on the held-out test trips, as `before`."""
        return self.summary["after"]["test"]

    @property
    def unexplained(self) -> dict[str, Any]:
        """What remains: whether it is significant, its share of the test variance, what it depends on."""
        return self.summary["unexplained"]

    def plot_before_after(self) -> "Figure":
        """Measured, before and after: the error of each trip and of its energy."""
        from hdev_jax.report.figures import before_after

        return self._drawn(before_after)

    def plot_residual(self) -> "Figure | None":
        """The residual of a test trip in time, before and after."""
        from hdev_jax.report.residuals import residual_in_time

        return self._drawn(residual_in_time)

    def plot_channels(self) -> "Figure | None":
        """The residual against the channels that it depends on most."""
        from hdev_jax.report.residuals import panels, residual_by_channel

        return self._drawn(lambda data: residual_by_channel(data, panels(data)[0]))

    def plot_energy(self) -> "Figure | None":
        """Energy by effect over the test trips; None where the target lies before the battery."""
        from hdev_jax.report.figures import energy_by_effect

        return self._drawn(energy_by_effect)

    def _write_report(self, folder: Path) -> None:
        from hdev_jax.report.page import write_report

        write_report(self.data, folder)


class CalibrationResult(Result):
    """A sheet's coefficients with their uncertainty.

    `draws`: draws of the posterior, where this call sampled it. A finished folder has them in `posterior.nc`, for
    ArviZ."""

    json_file = "calibration.json"
    sheet_file = "calibrated_vehicle.toml"

    def __init__(
        self, answer: str, summary: Mapping[str, Any], sheet: str, predictive: Mapping[str, Any],
        data: ReportData | Callable[[], ReportData], draws: "Draws | None" = None,
    ):  # fmt: skip
        super().__init__(answer, summary, sheet, predictive, data)
        self.draws = draws

    def write(self, run: Run, out: str | Path) -> None:
        """Everything into a run's folder, the draws included."""
        super().write(run, out)
        if self.draws is not None:
            self.draws.write(run.path("posterior.nc"))

    def __repr__(self) -> str:
        count, test = len(self.summary["baseline"]["parameters"]), self.before["rmse"]
        return f"CalibrationResult({count} coefficients; test RMSE {test:.4g} {self._unit})"

    @property
    def coefficients(self) -> "pd.DataFrame":
        """One row for each coefficient: `value`, `sd`, `unit`, and its prior: `prior_value`, `prior_sd`, `prior_z`."""
        import pandas as pd

        rows = pd.DataFrame(self.summary["baseline"]["parameters"]).T
        return rows.drop(columns="absorbs", errors="ignore")

    def _write_report(self, folder: Path) -> None:
        from hdev_jax.report.page import write_calibration_report

        write_calibration_report(self.data, folder)


class Prediction:
    """What a sheet predicts. `rows`: `trip_id, time_s, predicted, lower, upper, level`, a row for each of the log's."""

    def __init__(self, rows: "pd.DataFrame", answer: str):
        self.rows: pd.DataFrame = rows
        self._answer = answer

    def __str__(self) -> str:
        return self._answer

    def __repr__(self) -> str:
        return f"Prediction({len(self.rows)} rows of {self.rows['trip_id'].nunique()} trips)"
