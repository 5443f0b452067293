"""Results of the networks' tasks put together: by what predicts and on which rows, over vehicles, folds and seeds."""

from collections.abc import Sequence
from typing import Any

from experiments.runner.tables import readable
from hdev_jax.report import names

__all__ = [
    "FORM", "HELD", "MODELS", "NAMED", "OURS", "PAPER_MODEL", "PHYSICS", "WAYS", "Results", "distinct", "diverged",
    "gathered_scores", "given", "in_words", "named", "still_better", "trainings",
]  # fmt: skip

Results = Sequence[tuple[dict[str, Any], dict[str, Any]]]
WAYS = {"tabular": "physics, tables", "bayesian": "physics, Bayesian coefficients",
        "kernel": "physics, known effects, linear fit", "diagnosed": "physics, diagnosed effects"}  # fmt: skip
FORM = "its linear fit before training"
PHYSICS = "its physics part alone"
MODELS = ("A", "B", "C", "D")
PAPER_MODEL = "paper"  # the network as printed, and ours, among the models of a config
OURS = "ours"
# Names of the paper's rows in metrics.json.
NAMED = {PAPER_MODEL: "PINN", f"{PAPER_MODEL}, {PHYSICS}": "physics_predicted",
         WAYS["tabular"]: "physics_tabular"}  # fmt: skip
HELD = ("the inputs include the energy of the calibrated kernel and the efficiencies at its operating point, so only "
        "models with 'log columns only' are without physics")  # fmt: skip


def named(way: str) -> str:
    """What metrics.json calls a way of predicting: "ours" is there the side of a comparison, not a model."""
    way = NAMED.get(way, way)
    return f"our network{way.removeprefix(OURS)}" if way.partition(",")[0].partition(" ")[0] == OURS else way


def in_words(way: str) -> str:
    """What readers see of a model's name in tables and figures."""
    return readable(named(way))


def gathered_scores(results: Results) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Scores by (way of predicting, use), over vehicles, folds and seeds. What no seed changes is there once."""
    out: dict[tuple[str, str], list[dict[str, Any]]] = {}
    once: set[Any] = set()
    for task, result in results:
        name = task["name"]
        for key, found in result.items():
            if key not in (*WAYS, "network", "physics", "lightgbm", "form"):
                continue
            if task["model"]["kind"] == "vehicles":
                way = WAYS[key]
            else:
                way = name + {"physics": f", {PHYSICS}", "form": f", {FORM}"}.get(key, "")
            for use, scored in found.items():
                if key != "form" or (way, use, task["data"].get("fold")) not in once:
                    out.setdefault((way, use), []).append(scored)
                once.add((way, use, task["data"].get("fold")))
    return out


def distinct(results: Results) -> dict[tuple[str, str], tuple[int, int]]:
    """Rows and trips by (way, use) without those that another seed has, too: of each fold and vehicle once."""
    once: dict[tuple[str, str], dict[tuple[Any, ...], tuple[int, int]]] = {}
    for task, result in results:
        of = (task["data"].get("fold"), task.get("vehicle"))
        for key, (scored,) in gathered_scores([(task, result)]).items():
            once.setdefault(key, {})[of] = (scored["rows"], scored["trips"])
    return {key: (sum(n for n, _ in of.values()), sum(t for _, t in of.values())) for key, of in once.items()}


def trainings(results: Results) -> dict[str, tuple[int, int]]:
    """By model that is trained: how many trainings there are, and how many of them diverged."""
    out: dict[str, tuple[int, int]] = {}
    for task, result in results:
        if task["model"]["kind"] != "vehicles":
            n, lost = out.get(task["name"], (0, 0))
            out[task["name"]] = (n + 1, lost + ("diverged" in result))
    return out


def still_better(results: Results) -> list[str]:
    """Which models were still getting better when their epochs were over."""
    still = sorted({f"'{in_words(t['name'])}'" for t, r in results if r.get("still_better")})
    return [f"validation error still falling at the last epoch, in some training: {', '.join(still)}"] if still else []


def diverged(results: Results) -> list[str]:
    """How many trainings diverged, where any did."""
    lost = [f"'{in_words(model)}' {k} of {n}" for model, (n, k) in trainings(results).items() if k]
    return [f"diverged trainings, left out of all errors: {', '.join(lost)}"] if lost else []


def given(results: Results) -> list[str]:
    """Which models know the effects that the synthetic fleet hides, and which have those that a diagnosis named."""
    known = [in_words(WAYS["kernel"])] if any("kernel" in r for _, r in results) else []
    known += [in_words(t["name"]) for t, r in results if t["model"].get("effects") is True and "network" in r]
    named_by = [in_words(t["name"]) for t, r in results if t["model"].get("effects") == "diagnosed" and "network" in r]
    out = []
    for models, one, several, what in (
        (known, "is", "are", "given the effects that the fleet hides"),
        (named_by, "has", "have", "the effects that the diagnosis of training routes names"),
    ):
        if quoted := [f"'{n}'" for n in dict.fromkeys(models)]:
            out.append(f"{names.verbose_join(quoted)} {one if len(quoted) == 1 else several} {what}")
    return out
