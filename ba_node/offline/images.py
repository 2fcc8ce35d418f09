# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read images with their rig from a recording, or from a folder of pictures (``image_folder.py``)."""

from __future__ import annotations

import contextlib
import re
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.estimate import Transform
from ba_node.front_end.records import FrontEndError, Images
from ba_node.front_end.streams import (
    MODES,
    NEAR,
    RECTIFIED,
    Frame,
    OdometryBuffer,
    Streams,
    cameras_of,
    images_of,
    transform_of,
)
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError, absolute
from ba_node.measurements import CameraRig
from ba_node.messages.factory import stamp_ns_from_message
from ba_node.messages.topics import IMAGE_TYPES, INPUT_TYPES
from ba_node.offline.image_folder import Picture, find_pictures
from ba_node.offline.image_times import of_another, of_odometry
from ba_node.offline.rig import rig_of_recording, static_tree

_INFO, _RIG = INPUT_TYPES["camera_info"], INPUT_TYPES["camera_rig"]
_ODOMETRY, _TF = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
# The fixed frame of transforms, of which none is said (REP 105).
_FIXED = "odom"
_PACKED = re.compile(r"/compressed(Depth)?$")
_DEPTH_ENCODINGS = ("16UC1", "32FC1")
_QUEUE = 100
# Bytes of a message until after its header's stamp.
_STAMPED = 12


@dataclass(frozen=True)
class ImageRequest:
    """What a user says about images."""

    rig: CameraRig | None = None  # in place of what the recording or folder says
    topics: Mapping[str, str] = field(default_factory=dict)  # by left, right, rgb, depth, image, odometry
    rectified: bool = False  # p of camera_info is the camera; so it is where topics are called image_rect
    base: str = ""  # body frame in /tf_static, empty for the first camera
    rate_hz: float = 10.0  # of a folder whose pictures have no stamps
    poses: OdometryBuffer | None = None  # of an odometry that comes from elsewhere


@dataclass
class ImageSource:
    """Images of a rig by time. ``counted`` and ``notes`` fill while it is read."""

    rig: CameraRig
    mode: str  # stereo, rgbd or mono
    total: int  # images of the first camera
    read: Callable[[], Iterator[tuple[Images, Transform | None]]]  # images, and the odometry of their time if there is
    counted: Counter[str] = field(default_factory=Counter)  # images left out, by reason
    notes: dict[str, str] = field(default_factory=dict)  # the last words on each reason
    warnings: dict[str, str] = field(default_factory=dict)  # what is wrong though no image was left out, by kind
    unused_odometry: Callable[[], str] = str  # says in words which odometry there is that nobody asked for; empty: none


@contextlib.contextmanager
def open_images(path: Path, request: ImageRequest) -> Iterator[ImageSource]:
    """Open a recording or a folder of pictures.

    Raises:
        BagError: it has no images, it cannot be told which are meant, or nothing tells the rig.
        RigError: a YAML of the folder holds no rig.
    """
    if path.is_dir() and not (path / "metadata.yaml").exists() and not any(path.glob("*.mcap")):
        yield _of_folder(path, request)
        return
    with BagReader(path) as reader:
        yield _of_recording(reader, request)


def _of_recording(reader: BagReader, request: ImageRequest) -> ImageSource:
    chosen = _image_topics(reader, request)
    mode = next(mode for mode, names in MODES.items() if set(names) == set(chosen))
    rig = _first_cameras(request.rig or _recorded_rig(reader, request, chosen, mode), mode, str(reader.path))
    odometry = _odometry_of(reader, request)
    topics = {topic: name for name, topic in chosen.items()}

    def read() -> Iterator[tuple[Images, Transform | None]]:
        poses = OdometryBuffer() if odometry.topic else request.poses
        return _paired(source, _messages(reader, source, topics, odometry, poses), poses)

    source = ImageSource(rig, mode, 0, read)
    if not odometry.topic and request.poses is None:
        source.unused_odometry = lambda: _unused_odometry(reader, rig.frame_id)
    source.total = sum(1 for _ in reader.messages([chosen[MODES[mode][0]]]))
    if request.rig is None:
        source.warnings |= _changes(reader, [_info_of(reader, chosen[name]) for name in cameras_of(mode)], rig)
    return source


def _changes(reader: BagReader, infos: Sequence[str], rig: CameraRig) -> dict[str, str]:
    """Return in words which cameras change within a recording, of which the first that is said counts; by kind."""
    found: dict[str, str] = {}
    first: dict[str, tuple[bytes, Any]] = {}
    for topic, _, _, data in reader.messages(infos):
        if topic not in first:
            first[topic] = data[_STAMPED:], reader.decode(topic, data)
        elif data[_STAMPED:] != first[topic][0] and f"{topic} changes" not in found:
            with contextlib.suppress(BagError):
                message = reader.decode(topic, data)
                if any(list(getattr(message, key)) != list(getattr(first[topic][1], key)) for key in ("k", "d", "p")):
                    at = stamp_ns_from_message(message.header.stamp)
                    words = f"{topic} is another calibration from {at} ns on: the first is taken for all images"
                    found[f"{topic} changes"] = f"{words}; cut the recording there, or give --rig"
    moved = static_tree(reader).moved & {rig.frame_id, *rig.names}
    if moved:
        words = f"/tf_static says two places of {', '.join(sorted(moved))}: the last is taken"
        found["tf_static"] = f"{words}; let one node publish it, or give --rig"
    return found


@dataclass(frozen=True)
class _Odometry:
    """Where poses of the body come from."""

    topic: str = ""  # of nav_msgs/Odometry or of tf2_msgs/TFMessage; empty for none
    frame: str = ""  # the fixed frame of transforms; empty for odometry

    def poses(self, message: Any) -> Iterator[tuple[int, str, Transform]]:
        """Yield stamp (ns), frame on the body and its pose in the fixed frame of what a message says."""
        if not self.frame:
            pose = message.pose.pose
            stamp_ns = stamp_ns_from_message(message.header.stamp)
            yield stamp_ns, str(message.child_frame_id), transform_of(pose.position, pose.orientation)
            return
        for one in message.transforms:
            if str(one.header.frame_id).removeprefix("/") == self.frame:
                place = transform_of(one.transform.translation, one.transform.rotation)
                yield stamp_ns_from_message(one.header.stamp), str(one.child_frame_id).removeprefix("/"), place


def _odometry_of(reader: BagReader, request: ImageRequest) -> _Odometry:
    """Return the odometry that was asked for: a topic, or a topic of transforms with the fixed frame behind a colon."""
    if "odometry" not in request.topics:
        return _Odometry()
    name, _, frame = request.topics["odometry"].partition(":")
    topic = absolute(name)
    kind = reader.topics.get(topic)
    if kind == _TF:
        found = _Odometry(topic, frame or _FIXED)
        parents = _parents(reader, topic)
        if found.frame not in parents:
            there = ", ".join(sorted(parents)) or "none"
            raise BagError(f"{reader.path}: {topic} has no transform from {found.frame!r}: say --topic"
                           f" odometry={topic}:FRAME; there are transforms from: {there}")  # fmt: skip
        return found
    if kind != _ODOMETRY:
        there = ", ".join(name for name, kind in sorted(reader.topics.items()) if kind in (_ODOMETRY, _TF)) or "none"
        raise BagError(f"{reader.path}: odometry={topic}: no topic of {_ODOMETRY} or {_TF}; there are: {there}")
    return _Odometry(topic)


def _unused_odometry(reader: BagReader, body: str) -> str:
    """Return in words what of a recording would tell the scale of one camera; empty if nothing does plainly."""
    there = {topic: "nav_msgs/Odometry" for topic, kind in sorted(reader.topics.items()) if kind == _ODOMETRY}
    if not there:
        tree = static_tree(reader)
        for topic in (topic for topic, kind in reader.topics.items() if kind == _TF and topic.endswith("/tf")):
            found = _Odometry(topic, _FIXED)
            children = set[str]()
            with contextlib.suppress(BagError):  # of a topic that nobody asked for
                for _, _, _, data in reader.messages([topic]):
                    children |= {child for _, child, _ in found.poses(reader.decode(topic, data))}
            if any(child == body or tree.find(child, body) is not None for child in children):
                there[topic] = f"transforms from {_FIXED}"
    if not there:
        return ""
    named = ", ".join(f"{topic} ({kind})" for topic, kind in there.items())
    return f"the recording has {named}: --topic odometry={next(iter(there))} takes the scale from it"


def _parents(reader: BagReader, topic: str) -> set[str]:
    """Return the frames from which transforms of a topic lead."""
    messages = (reader.decode(topic, data) for topic, _, _, data in reader.messages([topic]))
    return {str(one.header.frame_id).removeprefix("/") for message in messages for one in message.transforms}


def _recorded_rig(reader: BagReader, request: ImageRequest, chosen: Mapping[str, str], mode: str) -> CameraRig:
    infos = [_info_of(reader, chosen[name], alone=mode != "stereo") for name in cameras_of(mode)]
    # A camera_rig tells all that camera_info would.
    known = [] if _RIG in reader.topics.values() and not set(infos) <= set(reader.topics) else infos
    rectified = request.rectified or any(RECTIFIED in chosen[name] for name in cameras_of(mode))
    rig = rig_of_recording(reader, known, rectified=rectified, base=request.base)
    if request.base not in ("", rig.frame_id):
        raise BagError(f"{reader.path}: /tf_static has no way from {request.base!r} (--base) to {rig.names[0]!r}")
    return rig


def _image_topics(reader: BagReader, request: ImageRequest) -> dict[str, str]:
    """Return the topic of each image of a mode: by what the user says, by names, or the only ones there."""
    found = sorted(topic for topic, kind in reader.topics.items() if kind in IMAGE_TYPES)
    given = {name: absolute(topic) for name, topic in request.topics.items() if name != "odometry"}
    for name, topic in given.items():
        if topic not in found:
            raise BagError(f"{reader.path}: {name}={topic}: no such topic of images; there are: {', '.join(found)}")
    # What is there raw and compressed is one image, and raw the better one.
    there = [topic for topic in found if topic == _PACKED.sub("", topic) or _PACKED.sub("", topic) not in found]
    for mode, names in MODES.items():
        short = [name.rpartition("/")[0] or "image" for name in names]
        if given and set(given) == set(short):
            return {name: given[key] for name, key in zip(names, short, strict=True)}
        named = [[topic for topic in there if _PACKED.sub("", topic).endswith(f"/{name}")] for name in names]
        if not given and [len(topics) for topics in named] == [1] * len(names) and (mode != "mono" or len(there) == 1):
            return {name: topics[0] for name, topics in zip(names, named, strict=True)}
    if not given and len(there) in (1, 2):
        return {MODES["mono"][0]: there[0]} if len(there) == 1 else _two(reader, there)
    if not there:
        raise BagError(f"{reader.path}: no images in it: a recording of keyframes and tracks is for ba replay")
    raise BagError(
        f"{reader.path}: cannot tell which images are meant of: {', '.join(there)}: say --topic left=TOPIC"
        " --topic right=TOPIC, rgb and depth, or image"
    )


def _two(reader: BagReader, topics: Sequence[str]) -> dict[str, str]:
    """Return two topics as colour and depth, or as left and right: the right one has a baseline in its p."""
    firsts = [next((reader.decode(topic, data) for *_, data in reader.messages([topic])), None) for topic in topics]
    depths = [getattr(first, "encoding", "") in _DEPTH_ENCODINGS for first in firsts]
    if sum(depths) == 1:
        return dict(zip(MODES["rgbd"], sorted(topics, key=lambda topic: depths[topics.index(topic)]), strict=True))
    shifts = []
    for topic in topics:
        info = next((reader.decode(t, data) for t, _, _, data in reader.messages([_info_of(reader, topic)])), None)
        shifts.append(0.0 if info is None else abs(float(info.p[3])))
    order = sorted(topics, key=lambda topic: shifts[topics.index(topic)])
    return dict(zip(MODES["stereo"], order, strict=True))


def _info_of(reader: BagReader, image: str, *, alone: bool = False) -> str:
    """Return the topic of the camera_info of an image: beside it, or for a camera that is alone, the only one."""
    beside = f"{_PACKED.sub('', image).rpartition('/')[0]}/camera_info"
    infos = [topic for topic, kind in reader.topics.items() if kind == _INFO]
    return infos[0] if alone and beside not in infos and len(infos) == 1 else beside


def _paired(
    source: ImageSource, entries: Iterator[tuple[str, int, Any]], poses: OdometryBuffer | None
) -> Iterator[tuple[Images, Transform | None]]:
    """Yield images by time, of entries (stream, stamp in ns, message) in order; each waits until its pose is known."""
    streams, waiting = Streams(MODES[source.mode], frozenset(), _QUEUE), deque[Frame]()
    came: dict[str, list[int]] = {name: [] for name in MODES[source.mode]}
    source.counted.clear()
    for name, stamp_ns, message in entries:
        came[name].append(stamp_ns)
        waiting += streams.put(name, stamp_ns, message)
        while waiting and (poses is None or poses.covers(waiting[0].stamp_ns)):
            yield from _read(source, waiting.popleft(), poses)
    for frame in (*waiting, *streams.flush()):
        yield from _read(source, frame, poses)
    source.counted.update(streams.counted)
    for name, apart_ns in streams.apart_ns.items():
        if apart_ns:
            when = of_another(came[MODES[source.mode][0]], came[name])
            nearest = f"the nearest is {apart_ns / 1e6:+.1f} ms off"
            source.notes[f"no {name}"] = f"{when}; {nearest}" if when else nearest
    first, *others = came
    for name in others:
        alone, nearest_ns = _alone(came[first], came[name])
        source.counted.pop(f"{name} alone", None)  # those that were seen to be on the way
        if alone:
            source.counted[f"{name} alone"] = alone
            source.notes[f"{name} alone"] = f"the nearest of {first} is {nearest_ns / 1e6:+.1f} ms off"
    if poses is not None and source.counted["no odometry"]:
        source.notes["no odometry"] = of_odometry(came[first], poses.span_ns) or source.notes["no odometry"]
    if poses is not None and poses.sparse:
        source.warnings["sparse odometry"] = poses.sparse


def _alone(first_ns: Sequence[int], other_ns: Sequence[int]) -> tuple[int, int]:
    """Return how many images of a second camera have none of the first near them, and how far off that is of the last.

    Near is by how often the first camera has images, the second one may have more.
    """
    if len(first_ns) < 2:
        return 0, 0
    first, other = np.unique(first_ns), np.asarray(other_ns, dtype=np.int64)
    at = np.clip(np.searchsorted(first, other), 1, len(first) - 1)
    after, before = first[at] - other, first[at - 1] - other
    off = np.where(np.abs(after) < np.abs(before), after, before)
    off = off[np.abs(off) > NEAR * np.median(np.diff(first))]
    return len(off), int(off[-1]) if len(off) else 0


def _messages(
    reader: BagReader,
    source: ImageSource,
    topics: Mapping[str, str],
    odometry: _Odometry,
    poses: OdometryBuffer | None,
) -> Iterator[tuple[str, int, Any]]:
    """Yield images of a recording; poses of its odometry go into the buffer."""
    tree, body = static_tree(reader), source.rig.frame_id
    fitting, others = set[str](), set[str]()
    for topic, _, _, data in reader.messages([*topics, *filter(None, [odometry.topic])]):
        try:
            message = reader.decode(topic, data)
        except BagError as error:
            _leave(source, "undecodable", str(error))
            continue
        if topic != odometry.topic or poses is None:
            yield topics[topic], stamp_ns_from_message(message.header.stamp), message
            continue
        for stamp_ns, child, pose in odometry.poses(message):
            place = tree.find(child, body) if child not in ("", body) else Transform(np.eye(3), np.zeros(3))
            (others if place is None else fitting).add(child)
            if place is None and odometry.frame:
                continue  # transforms of all kinds come on one topic
            if place is None:
                words = f"the odometry is of {child!r}, and /tf_static has no way from there to {body!r}"
                source.warnings["odometry of another frame"] = f"{words}: taken as the same"
            poses.add(stamp_ns, pose if place is None else pose.after(place))
    if odometry.frame and not fitting:
        words = f"transforms from {odometry.frame!r} are to {', '.join(sorted(others))}, and /tf_static has no way from"
        source.warnings["odometry of another frame"] = f"{words} there to {body!r}: record it, or say --base"


def _read(source: ImageSource, frame: Frame, poses: OdometryBuffer | None) -> Iterator[tuple[Images, Transform | None]]:
    """Yield what a frame shows and the pose of its time; nothing where either is not to be had, which is counted."""
    pose = None if poses is None else poses.at(frame.stamp_ns)
    if poses is not None and pose is None:
        _leave(source, "no odometry", f"none at stamp {frame.stamp_ns} ns")
        return
    try:
        images = images_of(frame, source.mode)
    except FrontEndError as error:
        _leave(source, "unreadable", f"image of stamp {frame.stamp_ns} ns: {error}")
        return
    yield images, pose


def _leave(source: ImageSource, reason: str, words: str) -> None:
    source.counted[reason] += 1
    source.notes[reason] = words


def _of_folder(path: Path, request: ImageRequest) -> ImageSource:
    found = find_pictures(path)
    mode = found.mode
    rig = _first_cameras(request.rig or found.rig(rectified=request.rectified), mode, str(path))
    entries = sorted(
        (stamp_ns, place, file)
        for place, (files, stamps) in enumerate(zip(found.pictures, found.stamps(request.rate_hz), strict=True))
        for stamp_ns, file in zip(stamps, files, strict=True)
    )
    streams = MODES[mode]

    def read() -> Iterator[tuple[Images, Transform | None]]:
        files = ((streams[place], stamp_ns, Picture(file)) for stamp_ns, place, file in entries)
        return _paired(source, files, request.poses)

    source = ImageSource(rig, mode, len(found.pictures[0]), read)
    if found.aside:
        words = ", ".join(str(file.relative_to(path)) for file in found.aside[:3])
        source.warnings["names"] = f"left out {len(found.aside)} pictures, which are not named as the others: {words}"
    return source


def _first_cameras(rig: CameraRig, mode: str, where: str) -> CameraRig:
    """Return the cameras of a rig that a mode has."""
    count = len(cameras_of(mode))
    if len(rig) < count:
        raise BagError(f"{where}: {mode} needs {count} cameras, and the rig has {len(rig)} ({', '.join(rig.names)})")
    names = ("names", "models", "intrinsics", "distortion", "image_size", "position", "orientation")
    return replace(rig, **{name: getattr(rig, name)[:count] for name in names})
