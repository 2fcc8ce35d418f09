# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold what a check of a set-up has found."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Row:
    """How well a hypothesis explains the tracks."""

    test: str  # what is compared
    hypothesis: str  # what is assumed
    share: float  # of the shared tracks that meet, in front of the cameras, 0 to 1
    rotation_deg: float = float("nan")  # angle between its rotation and that of the tracks; NaN if there is none
    direction_deg: float = float("nan")  # the same for the direction of the translation


@dataclass(frozen=True)
class Finding:
    """A likely mistake."""

    causes: tuple[str, ...]  # what it is, in words, or what it may be where the tracks cannot tell these apart
    evidence: str  # what the tracks say
    changes: tuple[str, ...]  # the field or parameter to change, for each cause
    harmful: bool = True  # solves would make poses worse
    usual: bool = False  # it is one of the mistakes that are made often, and explains the tracks; not only a misfit
    since_ns: int | None = None  # stamp of the keyframe from which on it is so; None for all of them, or unknown

    @property
    def sentence(self) -> str:
        """Return all of it."""
        causes, changes = (", or ".join(dict.fromkeys(part)) for part in (self.causes, self.changes))
        return f"{causes} ({self.evidence}): change {changes}"

    def narrowed(self, other: Finding) -> Finding | None:
        """Return this with the causes alone that another finding names too; None if there are none."""
        both = [pair for pair in zip(self.causes, self.changes, strict=True) if pair[0] in other.causes]
        if not both:
            return None
        causes, changes = zip(*both, strict=True)
        return dataclasses.replace(self, causes=causes, changes=changes, evidence=f"{self.evidence}; {other.evidence}")


@dataclass
class Diagnosis:
    """What the tracks tell about a set-up."""

    findings: list[Finding] = field(default_factory=list)  # likely mistakes, the surest first
    sound: list[str] = field(default_factory=list)  # what was tested and fits, in words
    untold: list[str] = field(default_factory=list)  # what the tracks could not tell (yet), and why
    rows: list[Row] = field(default_factory=list)  # the hypotheses
    notices: list[str] = field(default_factory=list)  # what is unusual but does no harm, keys of the scene's notices
    failed: list[str] = field(default_factory=list)  # tests that ended by a fault of their own, and which
    told: frozenset[str] = frozenset()  # the tests that need no more tracks

    @property
    def harmful(self) -> bool:
        """Return True if solves would make poses worse."""
        return any(finding.harmful for finding in self.findings)

    @property
    def since_ns(self) -> int | None:
        """Return the stamp from which on solves would make poses worse; None for all, or if that is not known."""
        since = [finding.since_ns for finding in self.findings if finding.harmful]
        return min((one for one in since if one is not None), default=None) if None not in since else None

    @property
    def usual(self) -> bool:
        """Return True if all that was found are usual mistakes."""
        return all(finding.usual for finding in self.findings)

    def summary(self) -> str:
        """Return the outcome in a sentence."""
        if self.findings:
            return "; ".join(finding.sentence for finding in self.findings)
        if not self.sound:
            return f"the tracks cannot tell: {'; '.join(self.untold)}"
        unknown = f"; not told: {'; '.join(self.untold)}" if self.untold else ""
        return f"the set-up fits the tracks: {'; '.join(self.sound)}{unknown}"

    def causes(self) -> str:
        """Return the likely mistakes alone."""
        return "; ".join(", or ".join(dict.fromkeys(finding.causes)) for finding in self.findings)

    def add(self, other: Diagnosis) -> None:
        """Take over what another test has found; findings with common causes become one."""
        for finding in other.findings:
            for i, known in enumerate(self.findings):
                both = known.narrowed(finding)
                if both is not None:
                    self.findings[i] = both
                    break
            else:
                self.findings.append(finding)
        self.sound += other.sound
        self.untold += other.untold
        self.rows += other.rows
        self.notices += other.notices
        self.failed += other.failed

    def as_dict(self) -> dict[str, Any]:
        """Return it for a JSON file."""
        return {
            "summary": self.summary(),
            "findings": [{**vars(one), "sentence": one.sentence} for one in self.findings],
            "sound": self.sound,
            "untold": self.untold,
            "hypotheses": [
                {k: (None if isinstance(v, float) and math.isnan(v) else v) for k, v in vars(row).items()}
                for row in self.rows
            ],
        }


def angle(degrees: float) -> str:
    """Return an angle as precisely as it is usually known."""
    number = f"{degrees:.1f}" if degrees < 0.75 else f"{degrees:.0f}"
    return f"{number} degree{'' if number == '1' else 's'}"
