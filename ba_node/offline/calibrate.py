# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Refine the cameras of a recording from its tracks, and write them as a rig with standard deviations."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ba_node.backend import Backend, Calibration
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import TopicChoice
from ba_node.io.files import whole_file
from ba_node.io.rig_file import rig_yaml
from ba_node.measurements import CameraRig, Measurement
from ba_node.offline.recording import placed

# Cameras that were far off let observations be left out that fit the refined ones: these are heard in the next round.
_ROUNDS = 4
# Of the offsets of clocks, s: what is less is rounding.
_DECIMALS = 12
# A round that moves no parameter by more than this many standard deviations is the last.
_SETTLED = 1.0


class CalibrateError(ValueError):
    """A recording from which nothing can be refined."""


@dataclass(frozen=True)
class Refined:
    """What came of a recording."""

    rig: CameraRig  # refined
    found: Calibration  # with the changes from the rig of the recording
    keyframes: int  # of the map that it is from
    rms_px: tuple[float, float]  # without outliers, at the end of the first round and of the last, px


def calibrate_recording(
    bag: list[Path],
    config: Config,
    topics: TopicChoice,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Refined:
    """Refine what ``calibration.*`` asks for over the whole map of the newest session.

    Raises:
        BagError: the recording cannot be read.
        CalibrateError: it gives no map.
    """
    # A set-up that is wrong would be held: here it is to be refined.
    backend = Backend(config.with_values({"guard.enabled": False, "guard.check_setup": False}))
    rigs: list[CameraRig] = []
    with BagReader(bag, topics) as reader:
        done = 0

        def listened(measurement: Measurement) -> Measurement:
            nonlocal done
            rigs.extend([measurement] if isinstance(measurement, CameraRig) else [])
            progress(done := done + 1, reader.message_count)
            return measurement

        for _ in backend.replay(map(listened, placed(reader.measurements(), reader, config.frames))):
            pass
        path = reader.path
    rms_px: list[float] = []
    found: Calibration | None = None
    for _ in range(_ROUNDS):
        if backend.optimize() is None:
            break
        before, found = found, backend.map.calibration
        rms_px.append(backend.map.report.rms_px_after)
        if before is not None and found is not None and _moved(before, found) < _SETTLED:
            break
    if found is None:
        reason = backend.map.summary().rejection_cause
        raise CalibrateError(f"{path}: no map could be made of it{': ' + reason if reason else ''}")
    return Refined(rig_of(rigs[-1], found), found, backend.map.keyframe_count, (rms_px[0], rms_px[-1]))


def write_rig(path: Path, refined: Refined) -> None:
    """Write the rig as YAML, with standard deviations, what was not told, and the offset of each camera's clock."""
    beside: list[dict[str, Any]] = []
    for camera in range(len(refined.rig)):
        own = [parameter for parameter in refined.found.parameters if parameter.camera == camera]
        beside.append(
            {
                "time_offset": round(float(refined.found.time_offset[camera]), _DECIMALS),
                "standard_deviations": {one.name: float(f"{one.sigma:.4g}") for one in own if one.told},
                "not_told": [one.name for one in own if not one.told],
            }
        )
    with whole_file(path) as file:
        file.write(rig_yaml(refined.rig, "own", beside)[0].encode())


def rig_of(rig: CameraRig, found: Calibration) -> CameraRig:
    """Return a rig with refined cameras; their places change against the first camera alone."""
    refined = found.cameras
    distortion = []
    for i, before in enumerate(rig.distortion):
        after = refined.params[i, 4:12]
        least = 5 if rig.models[i] in ("", "plumb_bob") else 4
        distortion.append(after[: max(len(before), least if after.any() else 0)].copy())
    orientation, position = rig.orientation.copy(), rig.position.copy()
    first = geometry.matrix_from_quaternion(rig.orientation[:1])[0], rig.position[0]
    for i in range(1, len(rig)):
        if any(one.camera == i and one.unit in ("rad", "m") and one.change for one in found.parameters):
            back = geometry.inverse(refined.rotation[i], refined.translation[i])
            from_first = geometry.compose(refined.rotation[0], refined.translation[0], *back)
            rotation, position[i] = geometry.compose(*first, *from_first)
            orientation[i] = geometry.quaternion_from_matrix(rotation[None])[0]
    models = tuple(model or ("plumb_bob" if d.any() else "") for model, d in zip(rig.models, distortion, strict=True))
    return dataclasses.replace(
        rig,
        models=models,
        intrinsics=refined.params[:, :4].copy(),
        distortion=tuple(distortion),
        orientation=orientation,
        position=position,
    )


def _moved(before: Calibration, found: Calibration) -> float:
    """Return the largest change of a parameter from one round to the next, in standard deviations."""
    pairs = zip(before.parameters, found.parameters, strict=True)
    return max((abs(now.change - then.change) / now.sigma for then, now in pairs if now.told), default=0.0)
