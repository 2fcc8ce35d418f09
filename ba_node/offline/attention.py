# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say what somebody has to look at after a replay; with anything of it the command ends with a code of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ba_node.backend import is_worse

# What arrives twice changes nothing.
HARMLESS = ("duplicate_keyframe", "duplicate_observation")
# What must not rise by more than a share. Outliers decide the rms of all, and good points do not follow them;
# one alone may be three times as far off, so that the rms with none above 10 sigmas must not fall.
_MEASURES = (
    ("rms_px", "rms of all", 0.5),
    ("bounded_px", "rms with none above 10 sigmas", 0.05),
    ("median_px", "median residual", 0.05),
)
# Half of all observations are nearer than this by their sigma_px, or the result explains little. By noise alone half
# are within 1.2.
_MAX_MEDIAN_SIGMAS = 3.0


def attention(report: Mapping[str, Any]) -> list[str]:
    """Return what a user has to know by the content of report.json, one sentence each; empty when all is well."""
    lines: list[str] = [*report.get("bag_warnings", {}).values()]
    for session in (*report["older_sessions"], report):
        lines += session["warnings"].values()
        of = f"session {session['session_id']}: " if report["older_sessions"] else ""
        lines += [of + line for line in (*_not_taken(session), *_worse(session), *turned_away(session["rejected"]))]
    return lines + turned_away(report["bag_rejected"])


def _not_taken(session: Mapping[str, Any]) -> list[str]:
    """Return which solves gave nothing, and why nothing was refined unless a warning has said that."""
    counts = [
        f"{session['solves_by_status'][name]} of {session['solves']} solves {name.lower()}"
        for name in ("FAILED", "HELD")
        if session["solves_by_status"].get(name)
    ]
    if session.get("keyframes_refined", 1):
        return [f"{count}: their result was not taken" for count in counts]
    reason, warnings = session["unrefined"], session["warnings"]
    known = any(reason in text for text in warnings.values()) or ("setup" in warnings and "set-up" in reason)
    known = known or "outvoted" in warnings
    # Without a solve a loaded map held all of it.
    stands = "the front-end's poses stand" if session["solves"] else "the poses of that map stand"
    return ["nothing was refined: " + "; ".join([*([] if known else [reason]), *counts, stands])]


def _worse(session: Mapping[str, Any]) -> list[str]:
    """Return that the result of a session explains little, or by which measures it is worse than what came in."""
    found = {}
    for key, name, share in _MEASURES:
        before, after = _both(session, key)
        if is_worse(before, after, share):
            found[key] = f"{name} {before:.3g} -> {after:.3g} px"
    before, after = _both(session, "bounded_px")
    sigmas = _both(session, "median_sigmas")[1]
    if session.get("keyframes_refined") and sigmas > _MAX_MEDIAN_SIGMAS:
        px = _both(session, "median_px")[1]
        text = (
            f"the result explains little of what was observed: half of it is over {sigmas:.2g} sigmas ({px:.2g} px)"
            " off: cameras, body_from_camera, poses, track ids or sigma_px are not what they are said to be; see what"
            " ba check says"
        )
        return [text]
    if not found or (set(found) == {"rms_px"} and after <= before):
        return []
    return [f"the result explains the observations worse than what came in: {', '.join(found.values())}"]


def _both(session: Mapping[str, Any], key: str) -> tuple[float, float]:
    """Return a measure before and after; NaN, which compares with nothing, for one that is not known."""
    values = (session.get(key, {}).get(state) for state in ("input", "refined"))
    before, after = (math.nan if value is None else value for value in values)
    return before, after


def turned_away(rejected: Mapping[str, int]) -> list[str]:
    """Return how many messages were turned away, by reason, but for those that do no harm."""
    counts = {reason: count for reason, count in rejected.items() if reason not in HARMLESS}
    return [f"turned away: {', '.join(f'{n} {reason}' for reason, n in counts.items())}"] if counts else []
