"""The flow of energy as a Sankey diagram: out of the battery, through loads and losses to the wheels, and back.

Coordinates are inches of the figure, y downwards, so that a band has one width along its whole way.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.energy.causes import place_of
from hdev_jax.energy.ledger import TOTAL, UNEXPLAINED
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, MEASURED, figure
from hdev_jax.report.energy.figures import BACK, label
from hdev_jax.report.figures import WIDTH, short

__all__ = ["CAPTION", "Band", "Flow", "energy_flow", "flow_of"]

CAPTION = (
    "Widths are in proportion to energy; percentages are shares of the measured energy; causes below 1 % "
    "are one band. Green comes back: into the "
    "battery, row by row, or from a cause whose sum is negative, such as a route that leads downhill."
)
LEAST_SHARE = 0.01  # of what leaves the battery: a cause below it is part of "other"
NOTHING_KWH = 1e-6  # of a flow that is drawn
OTHER = "other"
PLACES = {"load": "electrical loads", "loss": "losses", OTHER: "", UNEXPLAINED: "", "wheel": "at the wheels"}
COLOURS = {"load": "#E69F00", "loss": BEFORE, OTHER: "#56B4E9", UNEXPLAINED: GREY, "wheel": AFTER}
TALL, SLOT, GAP = 2.8, 0.2, 0.09  # height of all that enters; least height of a label's line; between bands
X_PLACE, X_CAUSE, BAR = 4.0, 6.35, 0.09  # where the two right columns are, and how wide a bar is
LEFT, CORNER = 1.95, 0.1  # room for the labels on the left; inner radius of a turn
MOST_BACK = X_PLACE - LEFT - 2 * CORNER - 0.4  # width of what comes back: its turn stays left of the middle column


@dataclass(frozen=True)
class Band:
    """A cause that takes energy, or gives it (`kwh` is above 0 either way), and where in the chain it does."""

    cause: str
    place: str
    kwh: float


@dataclass(frozen=True)
class Flow:
    """What enters, the battery's `out_kwh` and causes that give (`gives`), is what `takes` take and what comes back
    into the battery, `back_kwh`."""

    out_kwh: float
    back_kwh: float
    gives: tuple[Band, ...]
    takes: tuple[Band, ...]


def flow_of(rows: pd.DataFrame, regenerated_kwh: float) -> Flow | None:
    """The flows of one block of the ledger. None where nothing leaves the battery, or a cause is not known.

    Small causes are one band, "other", their sum; places in the order of the chain, the wheels last, and of a place
    the largest first.
    """
    kwh = {str(r["cause"]): float(r["kwh"]) for r in rows.to_dict("records")}
    out = kwh.pop(TOTAL, 0.0) + regenerated_kwh
    if not np.isfinite([out, *kwh.values()]).all() or out <= NOTHING_KWH:
        return None
    small = [c for c, x in kwh.items() if abs(x) < LEAST_SHARE * out and c != UNEXPLAINED]
    if len(small) > 1:  # one alone keeps its name
        kwh[OTHER] = sum(kwh.pop(c) for c in small)
    bands = [(Band(c, c if c in PLACES else place_of(c), abs(x)), x > 0) for c, x in kwh.items()
             if abs(x) > NOTHING_KWH]  # fmt: skip
    bands.sort(key=lambda b: ([*PLACES].index(b[0].place), -b[0].kwh))
    gives, takes = (tuple(b for b, takes in bands if takes is side) for side in (False, True))
    return Flow(out, regenerated_kwh, gives, takes)


def energy_flow(
    rows: pd.DataFrame, regenerated_kwh: float, km: float, *, title: str = "Where the energy goes"
) -> Any | None:
    """The diagram of one block of the ledger, labels in kWh/100 km (kWh where nothing was driven) and the share of the
    measured energy. None where nothing leaves the battery."""
    flow = flow_of(rows, regenerated_kwh)
    if flow is None:
        return None
    total = flow.out_kwh - flow.back_kwh
    shares = dict(zip(rows["cause"], rows["share_percent"], strict=True))
    has_share = total > 0 and bool(np.isfinite(shares[TOTAL]))

    def amount(kwh: float) -> str:
        return (f"{100 * kwh / km:.3g} kWh/100 km" if km > 0 else f"{kwh:.3g} kWh").replace("-", "−")

    def said(kwh: float) -> str:
        return f"{amount(kwh)} ({100 * kwh / total:.1f} %)".replace("-", "−") if has_share else amount(kwh)

    return _Drawing(flow, amount, said, title).fig


class _Drawing:
    """One diagram; `amount` and `said` write kWh as text, without and with its share."""

    def __init__(self, flow: Flow, amount: Callable[[float], str], said: Callable[[float], str], title: str) -> None:
        self.flow, self.amount, self.said = flow, amount, said
        entering = flow.out_kwh + sum(b.kwh for b in flow.gives)
        self.per = min(TALL / entering, MOST_BACK / max(flow.back_kwh, NOTHING_KWH))  # inches for a kWh
        back = self.per * flow.back_kwh
        turn = back + 2 * CORNER if back else 0.0
        self.x0, top = LEFT + turn, 0.5
        places = [p for p in PLACES if any(b.place == p for b in flow.takes) or (p == "wheel" and back)]
        bottom = self._right(places, top, back)
        middle = self.per * entering + 2.2 * GAP * (len(places) - 1)
        start = top + 0.5 * max(bottom - top - middle, 0.0)
        left = self.per * max(flow.out_kwh, flow.back_kwh)
        left += sum(max(self.per * b.kwh, SLOT) + GAP for b in flow.gives)
        lane = max(bottom, start + middle, start + left) + 2 * CORNER
        self.height = lane + back + (0.45 if back else 0.1)
        self.fig = figure(WIDTH, self.height)
        self.fig.set_layout_engine("none")
        self.ax = self.fig.add_axes((0.0, 0.0, 1.0, 1.0))
        self.ax.set(xlim=(0.0, WIDTH), ylim=(self.height, 0.0))
        self.ax.set_axis_off()
        self.ax.text(0.1, 0.2, title, fontweight="bold", fontsize=9, va="center")
        self._columns(places, start)
        if back:
            self._return(lane, back)

    def _right(self, places: Sequence[str], y: float, back: float) -> float:
        """Heights of the right column, a heading before the causes of each place; its lower end."""
        self.headings: dict[str, float] = {}
        self.right: list[tuple[Band, float]] = []
        for p in places:
            causes = [b for b in self.flow.takes if b.place == p]
            if PLACES[p]:
                self.headings[p] = y + 0.5 * SLOT
                y += SLOT
            for b in causes:
                tall = max(self.per * b.kwh, SLOT)
                self.right.append((b, y + 0.5 * (tall - self.per * b.kwh)))
                y += tall + 0.3 * GAP
            y += GAP
        self.back_at = y
        return y + back

    def _columns(self, places: Sequence[str], start: float) -> None:
        flow, per = self.flow, self.per
        amount = {p: sum(b.kwh for b in flow.takes if b.place == p) for p in places}
        if "wheel" in amount:
            amount["wheel"] += flow.back_kwh
        # left: the battery, below it what gives; each column's bands in one order, so that they hardly cross
        left = [("battery", flow.out_kwh, start)]
        tall = per * max(flow.out_kwh, flow.back_kwh)  # of the battery: more may come back than leaves, downhill
        y = start + tall + GAP
        for b in flow.gives:
            left.append((b.cause, b.kwh, y + 0.5 * max(SLOT - per * b.kwh, 0.0)))
            y += max(per * b.kwh, SLOT) + GAP
        y, node = start, {}
        for p in places:
            node[p] = y
            y += per * amount[p] + 2.2 * GAP
        filled = dict.fromkeys(places, 0.0)
        parts = _shared(left, [(b.cause, b.place) for b in flow.gives], amount)
        for cause, kwh, base in left:
            here = base
            for p in places:
                part = parts[cause].get(p, 0.0)
                if part > NOTHING_KWH:
                    colour = COLOURS[p] if cause == "battery" else BACK
                    self._band(self.x0 + BAR, here, X_PLACE, node[p] + per * filled[p], per * part, colour)
                    here, filled[p] = here + per * part, filled[p] + part
            colour = MEASURED if cause == "battery" else BACK
            self._bar(self.x0, base, tall if cause == "battery" else per * kwh, colour)
            if cause == "battery":
                free = tall - per * flow.back_kwh  # of its side, above what comes back
                x, y = self.x0 if free > 2.0 * SLOT else LEFT, base + max(0.5 * free, SLOT)
                words = f"out of the battery\n{self.amount(kwh)}"
                self.ax.text(x - 0.08, y, words, ha="right", va="center", fontsize=8)
            else:
                words = f"given back: {short(label(cause), 26)}\n{self.said(-kwh)}"
                self.ax.text(LEFT - 0.08, base + 0.5 * per * kwh, words, ha="right", va="center", fontsize=6.5)
        self.battery_foot = start + tall
        out = dict(node)
        for p in places:
            self._bar(X_PLACE, node[p], per * amount[p], COLOURS[p])
        for p, y in self.headings.items():
            mine = sum(b.kwh for b in flow.takes if b.place == p)
            self.ax.text(X_CAUSE, y, f"{PLACES[p]}  {self.said(mine)}", va="center", fontsize=8, color=GREY,
                         fontweight="bold")  # fmt: skip
        for b, y in self.right:
            tall = per * b.kwh
            self._band(X_PLACE + BAR, out[b.place], X_CAUSE, y, tall, COLOURS[b.place])
            out[b.place] += tall
            self._bar(X_CAUSE, y, tall, COLOURS[b.place])
            self.ax.text(X_CAUSE + BAR + 0.08, y + 0.5 * tall, f"{short(label(b.cause), 32)}  {self.said(b.kwh)}",
                         va="center", fontsize=8)  # fmt: skip
        if flow.back_kwh:
            self._band(X_PLACE + BAR, out["wheel"], X_CAUSE, self.back_at, per * flow.back_kwh, BACK)

    def _return(self, lane: float, back: float) -> None:
        """From the right column's foot around below everything into the battery's side."""
        foot, x_left = self.battery_foot, self.x0 - CORNER
        r, big = CORNER, CORNER + back
        half = 0.5 * (lane - self.back_at - back)  # inner radius of the turn on the right
        right = _arc(X_CAUSE, self.back_at + back + half, half + back, -90, 90)
        inner = _arc(X_CAUSE, self.back_at + back + half, half, 90, -90)
        up = [*_arc(x_left, lane + back - big, big, 90, 180), *_arc(x_left, foot - back + big, big, 180, 270)]
        outside = [*right, *up, (self.x0, foot - back)]
        inside = [(self.x0, foot), *_arc(x_left, foot + r, r, 270, 180), *_arc(x_left, lane - r, r, 180, 90), *inner]
        self._polygon([*outside, *inside], BACK)
        share = 100 * self.flow.back_kwh / self.flow.out_kwh
        of = f" ({share:.1f} % of what left it)" if share <= 100 else ""
        words = f"regenerated, back into the battery: {self.amount(self.flow.back_kwh)}{of}"
        self.ax.text(0.5 * (self.x0 + X_CAUSE), lane + back + 0.18, words, ha="center", va="center", fontsize=8)

    def _band(self, x0: float, y0: float, x1: float, y1: float, tall: float, colour: str) -> None:
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path

        mid = 0.5 * (x0 + x1)
        points = [(x0, y0), (mid, y0), (mid, y1), (x1, y1), (x1, y1 + tall), (mid, y1 + tall), (mid, y0 + tall),
                  (x0, y0 + tall), (x0, y0)]  # fmt: skip
        codes = [Path.MOVETO, *[Path.CURVE4] * 3, Path.LINETO, *[Path.CURVE4] * 3, Path.CLOSEPOLY]
        self.ax.add_patch(PathPatch(Path(points, codes), facecolor=colour, alpha=0.5, linewidth=0))

    def _polygon(self, points: Sequence[tuple[float, float]], colour: str) -> None:
        from matplotlib.patches import Polygon

        self.ax.add_patch(Polygon(points, closed=True, facecolor=colour, alpha=0.5, linewidth=0))

    def _bar(self, x: float, y: float, tall: float, colour: str) -> None:
        from matplotlib.patches import Rectangle

        self.ax.add_patch(Rectangle((x, y), BAR, tall, facecolor=colour, linewidth=0))


def _arc(x: float, y: float, radius: float, start: float, end: float) -> list[tuple[float, float]]:
    """Points of a circle between two angles [degrees, clockwise on the page from the right]."""
    angle = np.radians(np.linspace(start, end, 24))
    return list(zip(x + radius * np.cos(angle), y + radius * np.sin(angle), strict=True))


def _shared(
    entering: Sequence[tuple[str, float, float]], own: Sequence[tuple[str, str]], amount: Mapping[str, float]
) -> dict[str, dict[str, float]]:
    """How much of what enters goes to each place: what a cause gives stays at its own place as far as that takes it,
    then goes to the wheels and up the chain; the battery fills the rest."""
    left, at, parts = dict(amount), dict(own), {}
    for cause, kwh, _ in (*entering[1:], entering[0]):
        parts[cause] = mine = {}
        first = [at[cause]] if cause in at else []
        for p in (*(x for x in first if x in left), *reversed(left)):
            part = min(kwh, left[p])
            if part > 0:
                mine[p] = mine.get(p, 0.0) + part
                kwh, left[p] = kwh - part, left[p] - part
    return parts
