"""What no classifier of single rows can pass: in the hysteresis band only the past tells the gear.

The simulator's gear is clip(previous, lowest, highest) with `lowest` and `highest` functions of the row. Where they
agree the row tells the gear. Where they differ, the best guess is the likelier of the two given all that the row and
the sheet tell; how good it is, is estimated by a classifier of just that choice, trained on the training routes' rows
in the band with noiseless features, `lowest` and `highest` among them, and scored on the held-out rows. A held-out
accuracy is never above the Bayes bound but by chance: the bound may lie somewhat higher than the estimate, not lower.
For balanced accuracy each gear counts as common as it is in the held-out rows themselves, which no classifier knows.
"""

import numpy as np

from experiments.paper1.gears import GROUPS, Rows
from hdev_jax.learn.gears.classifiers import balanced_accuracy, scored

__all__ = ["bounds"]


def bounds(rows: Rows, seed: int) -> dict[str, float]:
    """By group and split: both accuracies of that guess, the share of rows in the band, and how many rows
    are of gears too rare to be scored."""
    from sklearn.ensemble import HistGradientBoostingClassifier

    band = rows.lowest < rows.highest
    fit = rows.where(band, rows.train)
    model = HistGradientBoostingClassifier(max_iter=150, learning_rate=0.08, min_samples_leaf=40, random_state=seed)
    model.fit(rows.oracle[fit], rows.gear[fit] == rows.highest[fit])
    upper = np.zeros(len(band))
    upper[band] = model.predict_proba(rows.oracle[band])[:, 1]
    plain = np.where(upper > 0.5, rows.highest, rows.lowest)
    out: dict[str, float] = {}
    for name in GROUPS:
        end = "" if name == "all" else "_" + name.replace(" ", "_")
        for split in ("unseen_routes", "unseen_variants"):
            at = rows.where(rows.group(name), getattr(rows, split))
            if not len(at):
                continue
            share = np.bincount(rows.gear[at], minlength=rows.highest.max() + 1) + 0.5
            rare = np.where(upper / share[rows.highest] > (1 - upper) / share[rows.lowest], rows.highest, rows.lowest)
            out[f"accuracy_{split}{end}"] = float(np.mean(plain[at] == rows.gear[at]))
            out[f"balanced_{split}{end}"] = balanced_accuracy(rows.gear[at], rare[at])
            out[f"rare_rows_{split}{end}"] = float(np.sum(~scored(rows.gear[at])))
            out[f"in_band_{split}{end}"] = float(np.mean(band[at]))
    return out
