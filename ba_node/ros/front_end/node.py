# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Track the images of live topics: the managed node ``ba_front_end``.

============  ==========================================================================================
configure     topics of images are looked for, by the mode; they and their cameras are subscribed to as they appear
activate      images are tracked; keyframes, tracks and first points are published
deactivate    images are ignored, the map of the tracker stays
cleanup       all of it goes; sessions that begin later have numbers of their own
============  ==========================================================================================

Poses that the back-end has refined (``ba_node/refined_keyframes``) go into the tracker's map as they come.
"""

from __future__ import annotations

import functools
import time
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.qos import ReliabilityPolicy

from ba_node.config import declared
from ba_node.config.front_end import FrontEndNodeOptions, FrontEndOptions
from ba_node.core import geometry
from ba_node.estimate import Correction, Poses
from ba_node.front_end.front_end import FrontEnd
from ba_node.front_end.images import read_mask
from ba_node.front_end.opencv import cv2, poselib
from ba_node.front_end.records import FrontEndError, State, Tracked
from ba_node.front_end.streams import (
    MASK,
    MODES,
    RECTIFIED,
    Frame,
    OdometryBuffer,
    Streams,
    cameras_of,
    images_of,
    transform_of,
)
from ba_node.io.rig_file import read_rig
from ba_node.measurements import Keyframe, Measurement
from ba_node.messages.cdr import tf_message
from ba_node.messages.conversion import InputMessages
from ba_node.messages.factory import ConversionError, header_message, pose_message, stamp_ns_from_message
from ba_node.messages.rig import rig_from_infos
from ba_node.messages.topics import IMAGE_TYPES, INPUT_TYPES, TF, TF_STATIC, TOPICS
from ba_node.messages.transforms import StaticTree
from ba_node.ros import qos
from ba_node.ros.log import Severity, Throttle, log
from ba_node.ros.message_factory import RclpyFactory, message_class
from ba_node.ros.parameters import declare
from ba_node.ros.rclpy_compat.lifecycle import ManagedNode
from ba_node.ros.tools.adapter import PUBLISHED

NODE_NAME = "ba_front_end"
_IMAGE, _COMPRESSED = IMAGE_TYPES
_ODOMETRY = "nav_msgs/msg/Odometry"
_LOOK_S, _LOG_S = 0.5, 5.0
# Frames that wait for cameras, or for the odometry of their time.
_MAX_WAITING = 30
# Stamps of images further in the future are wrong, s.
_MAX_AHEAD_S = 1.0
# Messages that wait for a back-end.
_MAX_UNSENT = 300
# A publisher that began anew counts anew.
_MAX_GAP = 10_000
# Images that have waited so long, s, are more than can be tracked.
_LATE_S = 1.0
# A number of the first session that no run before has had, as long as clocks go on: seconds since 2020.
_EPOCH_S = 1_577_836_800


class FrontEndNode(ManagedNode):
    """The node.

    Raises:
        ConfigError: a parameter does not exist or has a wrong value.
        RigError: there is no rig in the file that is named.
        FrontEndError: there is no mask in the file that is named, or a library is missing.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__(NODE_NAME, **node_options)
        own, tracking = declared(FrontEndNodeOptions), declared(FrontEndOptions)
        values: dict[str, Any] = dict(declare(self, (*own, *tracking)))
        self.options = FrontEndNodeOptions(**{parameter.name: values[parameter.name] for parameter in own})
        self._tracking = FrontEndOptions(**{parameter.name: values[parameter.name] for parameter in tracking})
        rig_file, mask_file = self.options.rig_file, self.options.mask_file
        self._given_rig = read_rig(rig_file, rectified=self.options.rectified) if rig_file else None
        for load in (cv2, poselib):
            load()  # now: it takes as long as many images
        self._mask = read_mask(mask_file) if mask_file else None
        self.counted: Counter[str] = Counter()  # images tracked and keyframes sent, and images left out by reason
        self._throttle, self._factory = Throttle(_LOG_S), RclpyFactory()
        self._messages = InputMessages(self._factory)
        self._entities: list[tuple[str, Any]] = []
        self._active = False
        self._session_id = max(1, int(self.get_clock().now().nanoseconds // 10**9) - _EPOCH_S)

    def start(self) -> None:
        """Configure and activate, if the parameter says so."""
        if self.options.autostart and self.request("configure"):
            self.request("activate")

    def configure(self) -> None:
        """Make publishers and subscriptions; those to images follow when somebody publishes them."""
        self.cleanup()
        options = self.options
        self._rig = self._given_rig
        self._mode = "" if options.mode == "auto" else options.mode
        self._streams: Streams | None = None
        self._subscribed: dict[str, str] = {}  # topic by stream
        self._came: set[str] = set()  # streams that images came of since the last report
        self._numbers: dict[str, int | None] = {}  # of the last image, as its publisher counts
        self._infos: dict[str, Any] = {}
        self._tree, self._odometry = StaticTree(), OdometryBuffer()
        self._front_end: FrontEnd | None = None
        self._frames: list[Frame] = []
        self._unsent: deque[tuple[str, Any]] = deque(maxlen=_MAX_UNSENT)
        self._state: State | None = None
        self._late_s, self._said = 0.0, ""
        kinds = {name: INPUT_TYPES[name] for name in PUBLISHED}
        self._out = {name: self._own("publisher", message_class(kind), name, qos.profile(TOPICS[name]))
                     for name, kind in kinds.items()}  # fmt: skip
        self._out["odometry"] = self._own("publisher", message_class(_ODOMETRY), "~/odometry", qos.reliable(100))
        self._out[TF] = self._own("publisher", message_class(TOPICS[TF].type_name), TF, qos.reliable(100))
        self._listen(TOPICS[TF].type_name, TF_STATIC, self._tree.add, qos.latched(100))
        self._listen(
            TOPICS["refined_keyframes"].type_name, "ba_node/refined_keyframes", self._on_refined, qos.reliable(100)
        )
        if options.odometry == "topic":
            self._listen(_ODOMETRY, "odometry", self._on_odometry, qos.reliable(1000))
        elif options.odometry == "tf":
            self._listen(TOPICS[TF].type_name, TF, self._on_tf, qos.reliable(1000))
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._own("timer", _LOOK_S, self._look, clock=clock)
        self._own("timer", _LOG_S, self._report, clock=clock)

    def activate(self) -> None:
        """Track."""
        self._active = True

    def deactivate(self) -> None:
        """Ignore images."""
        self._active = False

    def cleanup(self) -> None:
        """Destroy everything."""
        self._active = False
        while self._entities:
            kind, entity = self._entities.pop()
            getattr(self, f"destroy_{kind}")(entity)

    stop = cleanup

    def _own(self, kind: str, *arguments: Any, **options: Any) -> Any:
        entity = getattr(self, f"create_{kind}")(*arguments, **options)
        self._entities.append((kind, entity))
        return entity

    def _listen(self, kind: str, topic: str, take: Any, profile: Any, **options: Any) -> None:
        self._own("subscription", message_class(kind), topic, take, profile, **options)

    def _look(self) -> None:
        """Settle the mode, and subscribe to the images that it needs and that somebody publishes."""
        self._publish_unsent()
        found = [mode for mode, names in MODES.items() if all(self._published(name) for name in names)]
        self._mode = self._mode or (found[0] if found else "")
        if not self._mode:
            return
        names = (*MODES[self._mode], *((MASK,) if self.options.mask_topic else ()))
        if self._streams is None:
            self._streams = Streams(names, frozenset((MASK,)), self.options.queue_depth)
        for name in names:
            if name not in self._subscribed and (topic := self._published(name)):
                self._subscribe(name, *topic)

    def _published(self, name: str) -> tuple[str, str] | None:
        """Return topic and type of an image that somebody publishes, raw before compressed; None if nobody does."""
        topic = self.resolve_topic_name(name)
        choices = [(topic, _IMAGE), (f"{topic}/compressedDepth", _COMPRESSED), (f"{topic}/compressed", _COMPRESSED)]
        return next((choice for choice in choices if self.count_publishers(choice[0])), None)

    def _subscribe(self, name: str, topic: str, kind: str) -> None:
        profiles = [info.qos_profile.reliability for info in self.get_publishers_info_by_topic(topic)]
        profile = qos.reliable(self.options.queue_depth)
        if ReliabilityPolicy.BEST_EFFORT in profiles:
            profile.reliability = ReliabilityPolicy.BEST_EFFORT
        self._listen(kind, topic, functools.partial(self._on_image, name), profile)
        self._subscribed[name] = topic
        self._came.add(name)  # it had no time yet
        self._log(Severity.INFO, f"{topic} ({kind}) is taken as {name}, mode {self._mode}")
        if self._rig is None and name in cameras_of(self._mode):
            info, take = name.replace("image_raw", "camera_info"), functools.partial(self._on_info, name)
            beside = f"{topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info"
            # Who remaps the image alone means the camera beside it.
            beside = beside if self.count_publishers(beside) > self.count_publishers(info) else info
            # As with the cameras of ba_node: drivers publish them volatile, players latched.
            self._listen(INPUT_TYPES["camera_info"], beside, take, qos.latched(), **qos.at_peace())
            self._listen(INPUT_TYPES["camera_info"], beside, take, qos.SENSOR_DATA, **qos.at_peace())

    def _on_info(self, name: str, info: Any) -> None:
        known = self._infos.setdefault(name, info)
        if self._front_end is None:
            self._infos[name] = info
            self._go_on()
        elif any(list(getattr(known, key)) != list(getattr(info, key)) for key in ("k", "d", "p")):
            self._warn("camera_info", f"camera_info of {name} has changed: what came first stays, or configure anew")

    def _on_odometry(self, message: Any) -> None:
        pose = message.pose.pose
        self._move(message.header.stamp, str(message.child_frame_id), pose.position, pose.orientation)

    def _on_tf(self, message: Any) -> None:
        for one in message.transforms:
            if one.header.frame_id.removeprefix("/") == self.options.odom_frame:
                self._move(one.header.stamp, one.child_frame_id, one.transform.translation, one.transform.rotation)

    def _move(self, stamp: Any, child: str, position: Any, orientation: Any) -> None:
        """Take in a pose of the odometry, taken from its frame on the body to that of the rig."""
        pose, base = transform_of(position, orientation), self._rig.frame_id if self._rig else self.options.base_frame
        if base and child and child != base:
            place = self._tree.find(child, base)
            if place is None:
                words = f"the odometry is of {child!r} and the rig of {base!r}: /tf_static has no way between them"
                self._warn("odometry", words)
                return
            pose = pose.after(place)
        self._odometry.add(stamp_ns_from_message(stamp), pose)
        self._go_on()

    def _on_image(self, name: str, message: Any, info: Mapping[str, Any]) -> None:
        self._came.add(name)
        self._notice_losses(name, info["publication_sequence_number"])
        received_ns = info["received_timestamp"]  # 0 where the middleware does not tell
        self._late_s = (time.time_ns() - received_ns) / 1e9 if received_ns else 0.0
        if not self._active or self._streams is None:
            return
        before, stamp_ns = self._streams.counted.copy(), stamp_ns_from_message(message.header.stamp)
        ahead_s = (stamp_ns - self.get_clock().now().nanoseconds) / 1e9
        if ahead_s > _MAX_AHEAD_S:
            self._warn(
                "future", f"stamps of {name} are {ahead_s:.1f} s ahead of this machine's clock: set the clocks right"
            )
        self._frames += self._streams.put(name, stamp_ns, message)
        for reason in self._streams.counted - before:
            off = self._streams.apart_ns.get(reason.removeprefix("no "), 0)
            words = f", the nearest is {off / 1e6:+.1f} ms off" if off else ""
            self._warn(reason, f"{reason} for {self._streams.counted[reason]} images{words}")
        self._go_on()

    def _notice_losses(self, name: str, number: int | None) -> None:
        """Count images of a publisher that never came here: the numbers of the middleware leave none out."""
        before, self._numbers[name] = self._numbers.get(name), number
        if before is None or number is None or not 1 < number - before < _MAX_GAP:
            return
        if self.count_publishers(self._subscribed[name]) == 1:
            self.counted[f"lost {name}"] += number - before - 1
            words = "they come faster than they are tracked, or the network drops them (queue_depth, max_features)"
            self._warn(f"lost {name}", f"{self.counted[f'lost {name}']} images of {name} never came: {words}")

    def _go_on(self) -> None:
        """Track the frames whose cameras and odometry are known, or that have waited long."""
        while self._frames and self._active:
            if len(self._frames) <= _MAX_WAITING and not self._is_known(self._frames[0].stamp_ns):
                return
            try:
                self._track(self._frames.pop(0))
            except (FrontEndError, ConversionError) as error:
                self.counted["unusable"] += 1
                self._warn("unusable", f"{error} (images left out: {self.counted['unusable']})")

    def _is_known(self, stamp_ns: int) -> bool:
        """Return True if the cameras are known, and the odometry of a time."""
        cameras = self._rig is not None or all(name in self._infos for name in cameras_of(self._mode))
        return cameras and (self.options.odometry == "none" or self._odometry.covers(stamp_ns))

    def _track(self, frame: Frame) -> None:
        """Track one frame, and publish what comes of it."""
        front_end = self._front_end or self._begin()
        odometry = None if self.options.odometry == "none" else self._odometry.at(frame.stamp_ns)
        if front_end is None or (odometry is None and self.options.odometry != "none"):
            reason = "no camera_info" if front_end is None else "no odometry"
            self.counted[reason] += 1
            self._warn(reason, f"{reason} for {self.counted[reason]} images")
            return
        if self._odometry.sparse:
            self._warn("sparse", self._odometry.sparse)
        tracked = front_end.process(images_of(frame, self._mode), odometry)
        self.counted["images"] += 1
        for note in tracked.notes:
            self._warn(note, note)
        for measurement in tracked.measurements():
            self._send(measurement, tracked.stamp_ns)
        self._session_id = max(self._session_id, tracked.session_id + 1)
        if tracked.state is not self._state:
            self._state = tracked.state
            self._log(Severity.WARNING if self._state is State.LOST else Severity.INFO, f"now {self._state.value}")
        self._publish_pose(tracked)

    def _begin(self) -> FrontEnd | None:
        """Make the tracker once all cameras are known, and publish the rig."""
        options, cameras = self.options, cameras_of(self._mode)
        if self._rig is None:
            if any(name not in self._infos for name in cameras):
                return None
            infos = [self._infos[name] for name in cameras]
            rectified = options.rectified or any(RECTIFIED in self._subscribed[name] for name in cameras)
            rig = rig_from_infos(infos, rectified=rectified, tree=self._tree, base=options.base_frame)
            if options.base_frame not in ("", rig.frame_id):
                raise ConversionError(f"/tf_static has no way from {options.base_frame!r} to {rig.names[0]!r} (yet)")
            self._rig = rig
        self._front_end = FrontEnd(
            self._rig, self._tracking, mask=self._mask, session_id=self._session_id, fixed_frame=options.odom_frame
        )
        self._out["camera_rig"].publish(self._messages.of(self._rig, 0)[1])
        return self._front_end

    def _send(self, measurement: Measurement, stamp_ns: int) -> None:
        """Publish a measurement once the back-end listens; until then the newest of them wait."""
        self.counted["keyframes"] += isinstance(measurement, Keyframe)
        if len(self._unsent) == self._unsent.maxlen:
            self._warn("nobody", f"nobody listens to {self.resolve_topic_name('keyframes')}: keyframes are lost")
        self._unsent.append(self._messages.of(measurement, stamp_ns))
        self._publish_unsent()

    def _publish_unsent(self) -> None:
        heard = all(self._out[name].get_subscription_count() for name in ("keyframes", "feature_tracks"))
        while heard and self._unsent:
            name, message = self._unsent.popleft()
            self._out[name].publish(message)

    def _publish_pose(self, tracked: Tracked) -> None:
        """Publish where the body is now, with its covariance, and as a transform if nobody else does."""
        if tracked.pose is None or self._rig is None:
            return
        fixed, position = self.options.odom_frame, tracked.pose.translation
        orientation = geometry.quaternion_from_matrix(tracked.pose.rotation)
        header = header_message(self._factory, tracked.stamp_ns, fixed)
        message = message_class(_ODOMETRY)(header=header, child_frame_id=self._rig.frame_id)
        message.pose.pose = pose_message(self._factory, position, orientation)
        message.pose.covariance = self._factory.fixed(np.nan_to_num(tracked.covariance, nan=1e6).reshape(-1))
        self._out["odometry"].publish(message)
        if self.options.publish_tf and self.options.odometry == "none":
            placed = Correction(self._rig.frame_id, position, orientation)
            self._out[TF].publish(tf_message(placed, fixed, tracked.stamp_ns))

    def _on_refined(self, message: Any) -> None:
        if self._front_end is None or message.session_id != self._front_end.session_id:
            return
        ids, stamps = np.array(message.keyframe_id, np.uint64), np.array(message.stamp_ns, np.int64)
        position, orientation = np.reshape(message.position, (-1, 3)), np.reshape(message.orientation, (-1, 4))
        self._front_end.refine(Poses(ids, stamps, position, orientation))

    def _report(self) -> None:
        """Log what has become of the images, and what is missing."""
        names = MODES.get(self._mode, MODES["stereo"])
        wanted = [name for name in names if name not in self._subscribed and not self._published(name)]
        silent = [topic for name, topic in self._subscribed.items() if name not in self._came]
        words = summary = self.summary()
        if wanted:
            words += f"; nobody publishes {' and '.join(map(self.resolve_topic_name, wanted))}"
            words += "" if self._mode else ", nor the images of another mode"
        elif silent and self._active:
            words += f"; no image came for {_LOG_S:g} s of {' and '.join(silent)}"
        if self._late_s > _LATE_S:
            words += f"; images wait {self._late_s:.1f} s before they are tracked: lower max_features, or their rate"
        self._late_s = 0.0
        self._came.clear()
        if words != self._said:
            self._log(Severity.INFO if words == summary else Severity.WARNING, words)
            self._said = words

    def summary(self) -> str:
        """Return in words what has become of the images."""
        lost = self.counted if self._streams is None else self.counted + self._streams.counted
        left = ", ".join(
            f"{reason} = {n}" for reason, n in sorted(lost.items()) if reason not in ("images", "keyframes")
        )
        return f"{self.counted['images']} images, {self.counted['keyframes']} keyframes; left out: {left or 'nothing'}"

    def _warn(self, key: str, words: str) -> None:
        if self._throttle.passes(key, time.monotonic()):
            self._log(Severity.WARNING, words)

    def _log(self, severity: Severity, words: str) -> None:
        log(self, severity, words)
