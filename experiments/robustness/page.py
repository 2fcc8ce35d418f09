# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make tables of the rows of `ba robustness`, and a page of them."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from experiments.robustness.faults import FAULTS, RIGS, SOUND
from experiments.robustness.runs import FAULT_TABLE, KINDS, OUTLIER_TABLE, SHARES, Row

_GOALS = {"outliers_uniform": {0.3: 1.5, 0.5: 3.0}, "outliers_jumping": {0.3: 1.5, 0.5: 3.0}}
_GOALS["outliers_moving"] = {0.3: 3.0}
# From the worst to the best.
_VERDICTS = ("crash", "harm", "refused", "kept", "better")

_HEAD = """# Robustness

What `ba_node` publishes is to be at least as good as what came in, or to be what came in, with the cause in words.
`ba robustness` tries that on recordings made with faults (`experiments/robustness/faults`), each replayed as
`ba replay` does with the default parameters.

"""
_ABOUT_FAULTS = """## Faults

![Error published against error that came in, for every fault](images/robustness_faults.png)

A drive of 20 m with good odometry (noise 0.5 px, 1 % outliers). **before** and **after**: translation RMSE of the
front-end's poses and of what is published (se3 alignment), m{median}.
**verdict**{worst}: *better* than what came in; *kept*, within 10 % and 5 mm of it (of the rotation: 10 % and 0.1
degrees); *refused*, nothing is published; *harm*. **named**: in how many of the runs the words for the user name the
cause; a dash where there is nothing to say. Of sound recordings, how many gave no warning. A row is of the code
with which it was last run: rows are renewed one by one.

"""
_ABOUT_OUTLIERS = """## Outliers

![Error by share of outliers, for every rig and kind](images/robustness_outliers.png)

A loop of 30 m, 60 keyframes, 200 tracks. Each figure is the error published, divided by that of the same recording
without its outliers{median}.
Bold where it misses the goal: 1.5 at 30 % and 3 at 50 % for outliers anywhere in the image and for tracks that jump to
another point, 3 at 30 % for points on moving objects. **before**: the error of the front-end's poses by the same
measure.

"""


def page(rows: Sequence[Row]) -> str:
    """Return the page as Markdown."""
    faults = [row for row in rows if row["table"] == FAULT_TABLE]
    outliers = [row for row in rows if row["table"] == OUTLIER_TABLE]
    parts = [_HEAD]
    if faults:
        parts += [_summary(faults), _about(_ABOUT_FAULTS, faults), fault_table(faults)]
    if outliers:
        parts += ["\n" * bool(faults), _about(_ABOUT_OUTLIERS, outliers), outlier_table(outliers)]
    return "".join(parts)


def seeds(rows: Sequence[Row]) -> int:
    """Return with how many seeds the recordings were made."""
    return len({row["seed"] for row in rows})


def _about(text: str, rows: Sequence[Row]) -> str:
    """Say of how many recordings a figure tells."""
    count = seeds(rows)
    if count == 1:
        return text.format(median=", of one recording each", worst="")
    several = f", median of {count} recordings with other seeds, the worst in brackets where it is twice as much"
    return text.format(median=several, worst=", the worst of them")


def _summary(rows: Sequence[Row]) -> str:
    wrong = [row for row in rows if row["fault"] != SOUND]
    asked = [row for row in wrong if FAULTS[row["fault"]].named]
    sound = [row for row in rows if row["fault"] == SOUND]
    harmless = sum(row["verdict"] not in ("crash", "harm") for row in wrong)
    return (
        f"Of {len(wrong)} recordings with a fault {harmless} did no harm; of {len(asked)} whose cause is to be named"
        f" {sum(row['told'] for row in asked)} named it; of {len(sound)} sound ones"
        f" {sum(row['told'] for row in sound)} gave no warning.\n\n"
    )


def fault_table(rows: Sequence[Row]) -> str:
    """Return the table of faults."""
    lines = ["| fault | rig | amount | before | after | verdict | named |", "|---|---|---|---|---|---|---|"]
    for name in (SOUND, *FAULTS):
        for (rig, amount), cell in grouped(rows, name).items():
            named = f"{sum(row['told'] for row in cell)} of {len(cell)}"
            asked = name == SOUND or FAULTS[name].named
            about = "none" if name == SOUND else FAULTS[name].about
            verdict = min((row["verdict"] for row in cell), key=_VERDICTS.index)
            shown = verdict if verdict not in ("crash", "harm") else f"**{verdict}**"
            much = f"{amount:g}" if name != SOUND and FAULTS[name].amounts != (1.0,) else ""
            before, after = (spread([row[key] for row in cell]) for key in ("input_m", "published_m"))
            lines.append(f"| {about} | {rig} | {much} | {before} | {after} | {shown} | {named if asked else '–'} |")
    return "\n".join(lines) + "\n"


def outlier_table(rows: Sequence[Row]) -> str:
    """Return the table of outliers."""
    shares = [share for share in SHARES if any(row["amount"] == share for row in rows)]
    head = ["outliers", "rig", "before", "without, m", *(f"{share:.0%}" for share in shares)]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for kind in KINDS:
        for rig in RIGS:
            cells = {share: cell for (name, share), cell in grouped(rows, kind).items() if name == rig}
            if not cells:
                continue
            every = [row for cell in cells.values() for row in cell]
            optimum = median(row["optimum_m"] for row in every)
            before = median(row["input_m"] / row["optimum_m"] for row in every)
            ratios = (_ratio(cells.get(share, []), _GOALS[kind].get(share)) for share in shares)
            about = FAULTS[kind].about.removesuffix(", share")
            lines.append(f"| {about} | {rig} | {before:.1f} | {optimum:.4f} | {' | '.join(ratios)} |")
    return "\n".join(lines) + "\n"


def grouped(rows: Sequence[Row], fault: str) -> dict[tuple[str, float], list[Row]]:
    """Return the rows of a fault by rig and amount, in the order of the catalogue."""
    groups: dict[tuple[str, float], list[Row]] = {}
    for row in rows:
        if row["fault"] == fault:
            groups.setdefault((row["rig"], row["amount"]), []).append(row)
    return groups


def spread(values: Sequence[float | None], digits: str = ".4g") -> str:
    """Return the median, and the worst in brackets where it is twice as much."""
    known = [value for value in values if value is not None]
    if not known:
        return "–"
    middle, worst = median(known), max(known)
    return f"{middle:{digits}}" + (f" ({worst:{digits}})" if worst > 2.0 * middle else "")


def _ratio(rows: Sequence[Row], goal: float | None) -> str:
    if not rows:
        return "–"
    ratios = [row["published_m"] / row["optimum_m"] for row in rows]
    text = spread(ratios, ".2f")
    return f"**{text}**" if goal is not None and median(ratios) > goal else text
