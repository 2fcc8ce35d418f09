# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Convert a recording of another front-end into one of keyframes, tracks, guesses and a rig."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError, absolute
from ba_node.measurements import CameraRig, Measurement
from ba_node.messages.adapters import SOURCES, Adapter, AdapterOptions, Input, Source
from ba_node.messages.adapters.rtabmap import BODY
from ba_node.offline.recording import record
from ba_node.offline.rig import rig_of_recording

# Taken where the recording has no topic of the other.
_INSTEAD = {"rtabmap": "rtabmap_map"}


def adapt(
    path: Path, target: Path, source: str, options: AdapterOptions, cameras: int, topics: Mapping[str, str]
) -> Adapter:
    """Write what a source published as keyframes and tracks; return the adapter, with its counts.

    The last calibration that the recording tells is used: sources that calibrate while they run end with the best.

    Args:
        path: recording, as :class:`BagReader` takes it.
        target: ``*.mcap`` to write.
        source: one of :data:`SOURCES`.
        options: of the adapter.
        cameras: how many cameras ids are of, where ids tell the camera.
        topics: topic of an input where its name does not tell it.

    Raises:
        BagError: topics are missing, nothing tells the cameras, or no keyframe comes of it.
    """
    known = {one.name for name in (source, _INSTEAD.get(source, source)) for one in SOURCES[name].inputs}
    if unknown := sorted(set(topics) - known):
        raise BagError(f"--topic {unknown[0]}: {source} has no such input; it has: {', '.join(sorted(known))}")
    with BagReader(path) as reader:
        kinds = {one.type_name for one in SOURCES[source].inputs if one.role}
        if source in _INSTEAD and not kinds & set(reader.topics.values()) - {"nav_msgs/msg/Odometry"}:
            source = _INSTEAD[source]
        chosen = choose_topics(reader, SOURCES[source].inputs, topics, has_rig=options.rig is not None)
        adapter = Adapter(SOURCES[source](cameras), options)
        rig = None if options.rig is not None else _calibration(reader, SOURCES[source](cameras), chosen)
        if rig is not None:
            adapter.calibrate(rig)
        record(target, _timeline(reader, adapter, chosen))
    return adapter


def choose_topics(
    reader: BagReader, inputs: tuple[Input, ...], given: Mapping[str, str], *, has_rig: bool
) -> dict[str, str]:
    """Return the input that is on each topic taken: by what the user says, by name and type, or the only one of a type.

    Raises:
        BagError: one is missing, or several are possible.
    """
    chosen: dict[str, str] = {}
    done: set[str] = set()
    for one in inputs:
        if one.role in done or (one.role == "" and not one.type_name):
            continue
        same = [topic for topic, kind in sorted(reader.topics.items()) if kind == one.type_name]
        named = [topic for topic in same if topic.rpartition("/")[2] == one.name]
        if not named and sum(other.type_name == one.type_name for other in inputs) == 1:
            named = same
        if one.name in given:
            named = [topic for topic in same if topic == absolute(given[one.name])]
        if len(named) > 1 and not one.role and one.name not in given:
            continue  # not needed, so that nothing is guessed
        if len(named) > 1:
            raise BagError(
                f"{reader.path}: cannot tell which {one.name} is meant: {', '.join(named)}: say --topic"
                f" {one.name}={named[0]}"
            )
        if named:
            chosen[named[0]] = one.name
            done |= {one.role} - {""}
    for one in inputs:
        if one.role and one.role not in done and one.type_name and not (one.role == "extrinsic" and has_rig):
            there = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(reader.topics.items())) or "none"
            or_rig = ", or --rig FILE" if one.role == "extrinsic" else ""
            say = f"say --topic {one.name}=TOPIC{or_rig}"
            raise BagError(f"{reader.path}: no {one.name} ({one.type_name}): {say}; there are: {there}")
    return chosen


def _calibration(reader: BagReader, source: Source, chosen: Mapping[str, str]) -> CameraRig | None:
    """Return the last rig that the source tells, else that of camera_info and /tf_static, None if there is neither."""
    adapter = Adapter(source, AdapterOptions())
    roles = {one.name: one.role for one in source.inputs}
    apart = "extrinsic" in roles.values()
    topics = [topic for topic, name in chosen.items() if not apart or roles[name] in ("extrinsic", "")]
    for topic, _, _, data in reader.messages(topics):
        for _ in adapter.take(chosen[topic], reader.decode(topic, data)):
            pass
        if adapter.rig is not None and not apart:
            break
    if adapter.rig is not None or apart:
        return adapter.rig
    try:
        rig = rig_of_recording(reader, rectified=True, base=BODY)
    except BagError as error:
        raise BagError(f"{error} (--rig FILE)") from error
    if rig.frame_id != BODY:
        raise BagError(
            f"{reader.path}: /tf_static has no way from {BODY!r}, which the poses are of, to {rig.names[0]!r}:"
            " give the cameras with --rig FILE"
        )
    return rig


def _timeline(reader: BagReader, adapter: Adapter, chosen: Mapping[str, str]) -> Iterator[tuple[str, int, Measurement]]:
    for topic, _, _, data in reader.messages(list(chosen)):
        try:
            message = reader.decode(topic, data)
        except BagError as error:
            adapter.counted["undecodable"] += 1
            adapter.notes["undecodable"] = str(error)
            continue
        yield from adapter.take(chosen[topic], message)
    adapter.finish()
    if not adapter.sent:
        why = "; ".join(f"{reason} = {adapter.counted[reason]}: {words}" for reason, words in adapter.notes.items())
        raise BagError(f"{reader.path}: no keyframe comes of {adapter.images} images: {why or 'nothing was there'}")
