# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn messages into arrays and arrays into messages, whatever library the messages come from.

Everything here works on attributes with the names of the ROS fields, so the classes of rclpy and the
dataclasses of rosbags are both served; how a message is made is left to a :class:`MessageFactory`.
Arrays are copied out of a message whole: no loop over tracks or points, and nothing that is kept
holds on to the buffer of a message or of a file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import FloatArray
from ba_node.measurements import (
    CameraRig,
    FeatureTracks,
    GlobalFix,
    GravityDirection,
    Keyframe,
    LandmarkGuesses,
    LandmarkPriors,
    Measurement,
    PosePrior,
    RelativePose,
    TrackMerge,
)
from ba_node.messages.camera_info import Lens, lens_of
from ba_node.messages.factory import (
    ConversionError,
    MessageFactory,
    float32,
    header_message,
    pose_message,
    stamp_ns_from_message,
)
from ba_node.messages.topics import INPUT_TYPES

_NO_LENS = Lens(np.zeros(4), np.zeros(0), np.zeros(2, np.int64))


def measurement_from_message(type_name: str, msg: Any) -> Measurement:
    """Return what an input message says.

    Arrays of a message that do not fit together, or a camera that cannot be, are not an error here: the measurement
    says so in ``malformed``, and the scene counts it.

    Raises:
        ConversionError: the type is not an input.
    """
    read = _READERS.get(type_name)
    if read is not None:
        return read(msg)
    raise ConversionError(f"type {type_name!r} is not an input: expected one of {', '.join(INPUT_TYPES.values())}")


def _array(values: Any, dtype: Any) -> NDArray[Any]:
    return np.array(values, dtype=dtype).reshape(-1)


def _keyframe(msg: Any) -> Keyframe:
    pose = msg.pose.pose
    return Keyframe(
        session_id=int(msg.session_id),
        keyframe_id=int(msg.keyframe_id),
        stamp_ns=stamp_ns_from_message(msg.header.stamp),
        frame_id=str(msg.header.frame_id),
        position=_xyz(pose.position),
        orientation=_xyzw(pose.orientation),
        covariance=_known(getattr(msg.pose, "covariance", ())),
    )


def _known(covariance: Any) -> FloatArray:
    """Return a covariance, empty where all is zero, which stands for unknown."""
    values = _array(covariance, np.float64)
    return values if values.any() else np.empty(0)


def _tracks(msg: Any) -> FeatureTracks:
    track_id = _array(msg.track_id, np.uint64)
    n = len(track_id)
    columns = {name: _array(getattr(msg, name), np.float64) for name in ("u", "v", "sigma_px", "depth_m")}
    wrong = [
        f"{name} has {len(column)} entries, track_id {n}"
        for name, column in columns.items()
        if len(column) != n and not (name in ("sigma_px", "depth_m") and len(column) == 0)
    ]
    if wrong:
        track_id = track_id[:0]
        columns = {name: np.empty(0) for name in columns}
    return FeatureTracks(
        session_id=int(msg.session_id),
        keyframe_id=int(msg.keyframe_id),
        camera_index=int(msg.camera_index),
        track_id=track_id,
        uv=np.stack([columns["u"], columns["v"]], axis=1),
        sigma_px=columns["sigma_px"],
        depth_m=columns["depth_m"],
        malformed="; ".join(wrong),
    )


def _guesses(msg: Any) -> LandmarkGuesses:
    track_id = _array(msg.track_id, np.uint64)
    position = _array(msg.position, np.float64)
    malformed = ""
    if len(position) != 3 * len(track_id):
        malformed = (
            f"position has {len(position)} entries, track_id {len(track_id)}: expected three coordinates for each track"
        )
        track_id, position = track_id[:0], position[:0]
    return LandmarkGuesses(int(msg.session_id), track_id, position.reshape(-1, 3), malformed)


def _relative(msg: Any) -> RelativePose:
    pose = msg.pose.pose
    return RelativePose(
        int(msg.session_id),
        int(msg.from_keyframe_id),
        int(msg.to_keyframe_id),
        int(msg.kind) == _LOOP,
        _xyz(pose.position),
        _xyzw(pose.orientation),
        _array(msg.pose.covariance, np.float64),
    )


def _priors(msg: Any) -> LandmarkPriors:
    track_id = _array(msg.track_id, np.uint64)
    n, position, covariance = len(track_id), _array(msg.position, np.float64), _array(msg.covariance, np.float64)
    malformed = ""
    if len(position) != 3 * n or len(covariance) != 9 * n:
        malformed = f"{n} tracks, {len(position)} coordinates and {len(covariance)} covariances: expected n, 3n, 9n"
        track_id, position, covariance = track_id[:0], position[:0], covariance[:0]
    rows = position.reshape(-1, 3), covariance.reshape(-1, 3, 3)
    return LandmarkPriors(int(msg.session_id), str(msg.header.frame_id), track_id, *rows, malformed)


def _merge(msg: Any) -> TrackMerge:
    track_id, same_as = _array(msg.track_id, np.uint64), _array(msg.same_as, np.uint64)
    malformed = ""
    if len(track_id) != len(same_as):
        malformed = f"track_id has {len(track_id)} entries, same_as {len(same_as)}: expected as many"
        track_id, same_as = track_id[:0], same_as[:0]
    return TrackMerge(int(msg.session_id), track_id, same_as, malformed)


def _gravity(msg: Any) -> GravityDirection:
    return GravityDirection(int(msg.session_id), int(msg.keyframe_id), _xyz(msg.down), float(msg.sigma_rad))


def _pose_prior(msg: Any) -> PosePrior:
    pose = msg.pose.pose
    values = _xyz(pose.position), _xyzw(pose.orientation), _array(msg.pose.covariance, np.float64)
    return PosePrior(stamp_ns_from_message(msg.header.stamp), str(msg.header.frame_id), *values)


def _fix(msg: Any) -> GlobalFix:
    return GlobalFix(
        stamp_ns_from_message(msg.header.stamp),
        str(msg.header.frame_id),
        np.array([msg.latitude, msg.longitude, msg.altitude], dtype=np.float64),
        _array(msg.position_covariance, np.float64),
        int(msg.status.status) >= 0,
    )


def rig_from_parts(frame_id: str, cameras: Sequence[Any], poses: Sequence[Any] | None) -> CameraRig:
    """Return the rig; without poses the cameras sit at the origin of the body."""
    n = len(cameras)
    names = tuple(str(info.header.frame_id) for info in cameras)
    read = [_lens(info) for info in cameras]
    lenses, wrong = [lens for lens, _ in read], ""
    if poses is not None and len(poses) != n:
        wrong = f"cameras has {n} entries, body_from_camera {len(poses)}: expected one pose for each camera"
    for i, (_, why) in enumerate(read):
        if why:
            wrong = wrong or f"camera {i} ({names[i]!r}): {why}"
    position, orientation = np.zeros((n, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    if poses and not wrong:
        position = np.array([_xyz(pose.position) for pose in poses])
        orientation = np.array([_xyzw(pose.orientation) for pose in poses])
    return CameraRig(
        frame_id=frame_id,
        names=names,
        models=tuple(str(info.distortion_model) for info in cameras),
        intrinsics=np.array([lens.intrinsics for lens in lenses]).reshape(-1, 4),
        distortion=tuple(lens.distortion for lens in lenses),
        image_size=np.array([lens.image_size for lens in lenses], dtype=np.int64).reshape(-1, 2),
        position=position,
        orientation=orientation,
        malformed=wrong,
        notes=tuple(f"camera {i} ({names[i]!r}): {lens.note}" for i, lens in enumerate(lenses) if lens.note),
    )


def _lens(info: Any) -> tuple[Lens, str]:
    """Return the camera of a message, and why it cannot be used."""
    try:
        return lens_of(info), ""
    except ConversionError as error:
        return _NO_LENS, str(error)


def _xyz(vector: Any) -> FloatArray:
    return np.array([vector.x, vector.y, vector.z], dtype=np.float64)


def _xyzw(quaternion: Any) -> FloatArray:
    return np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w], dtype=np.float64)


def keyframe_message(factory: MessageFactory, keyframe: Keyframe) -> Any:
    """Return a ``ba_msgs/Keyframe``."""
    pose = factory.make(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=pose_message(factory, keyframe.position, keyframe.orientation),
        covariance=factory.fixed(keyframe.covariance if len(keyframe.covariance) else np.zeros(36)),
    )
    return factory.make(
        INPUT_TYPES["keyframes"],
        header=header_message(factory, keyframe.stamp_ns, keyframe.frame_id),
        session_id=keyframe.session_id,
        keyframe_id=keyframe.keyframe_id,
        pose=pose,
    )


def tracks_message(factory: MessageFactory, tracks: FeatureTracks, stamp_ns: int, frame_id: str) -> Any:
    """Return a ``ba_msgs/FeatureTracks``; ``frame_id`` is the optical frame of the camera."""
    columns = {"u": tracks.uv[:, 0], "v": tracks.uv[:, 1], "sigma_px": tracks.sigma_px, "depth_m": tracks.depth_m}
    return factory.make(
        INPUT_TYPES["feature_tracks"],
        header=header_message(factory, stamp_ns, frame_id),
        session_id=tracks.session_id,
        keyframe_id=tracks.keyframe_id,
        camera_index=tracks.camera_index,
        track_id=factory.array(tracks.track_id),
        **{name: factory.array(float32(column)) for name, column in columns.items()},
    )


def guesses_message(factory: MessageFactory, guesses: LandmarkGuesses, stamp_ns: int, frame_id: str) -> Any:
    """Return a ``ba_msgs/LandmarkGuesses``; ``frame_id`` is the fixed frame."""
    return factory.make(
        INPUT_TYPES["landmark_guesses"],
        header=header_message(factory, stamp_ns, frame_id),
        session_id=guesses.session_id,
        track_id=factory.array(guesses.track_id),
        position=factory.array(guesses.position.reshape(-1)),
    )


def rig_message(factory: MessageFactory, rig: CameraRig, stamp_ns: int) -> Any:
    """Return a ``ba_msgs/CameraRig``."""
    return factory.make(
        INPUT_TYPES["camera_rig"],
        header=header_message(factory, stamp_ns, rig.frame_id),
        cameras=[_camera_info(factory, rig, index, stamp_ns) for index in range(len(rig))],
        body_from_camera=[pose_message(factory, p, q) for p, q in zip(rig.position, rig.orientation, strict=True)],
    )


def _camera_info(factory: MessageFactory, rig: CameraRig, index: int, stamp_ns: int) -> Any:
    fx, fy, cx, cy = rig.intrinsics[index]
    width, height = rig.image_size[index]
    region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return factory.make(
        INPUT_TYPES["camera_info"],
        header=header_message(factory, stamp_ns, rig.names[index]),
        height=int(height),
        width=int(width),
        distortion_model=rig.models[index],
        d=factory.array(rig.distortion[index]),
        k=factory.fixed(np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])),
        r=factory.fixed(np.eye(3).reshape(-1)),
        p=factory.fixed(np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0])),
        binning_x=0,
        binning_y=0,
        roi=factory.make("sensor_msgs/msg/RegionOfInterest", **region),
    )


def side_message(factory: MessageFactory, what: Measurement, stamp_ns: int = 0, frame_id: str = "") -> tuple[str, Any]:
    """Return the input and the message of what is known beside pixels; ``frame_id`` is that of the body.

    Raises:
        ConversionError: it is none of these.
    """
    if isinstance(what, PosePrior | GlobalFix):
        stamp_ns, frame_id = what.stamp_ns, what.frame_id
    elif isinstance(what, LandmarkPriors):
        frame_id = what.frame_id
    fields = {"header": header_message(factory, stamp_ns, frame_id)}
    if isinstance(what, RelativePose | PosePrior):
        fields["pose"] = factory.make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=pose_message(factory, what.position, what.orientation),
            covariance=factory.fixed(what.covariance),
        )
    if isinstance(what, PosePrior):
        return _made(factory, "pose_prior", fields)
    if isinstance(what, GlobalFix):
        status = factory.make("sensor_msgs/msg/NavSatStatus", status=0 if what.is_fix else -1, service=1)
        names = dict(zip(("latitude", "longitude", "altitude"), what.geodetic.tolist(), strict=True))
        known = {"position_covariance": factory.fixed(what.covariance), "position_covariance_type": 3}
        return _made(factory, "gnss", fields | {"status": status} | names | known)
    if isinstance(what, RelativePose):
        ends = {"from_keyframe_id": what.from_keyframe_id, "to_keyframe_id": what.to_keyframe_id}
        return _made(factory, "relative_poses", fields | ends | _session(what) | {"kind": int(what.is_loop)})
    if isinstance(what, LandmarkPriors | TrackMerge):
        named = {key: factory.array(v.reshape(-1)) for key, v in vars(what).items() if isinstance(v, np.ndarray)}
        name = "track_merges" if isinstance(what, TrackMerge) else "landmark_priors"
        return _made(factory, name, fields | _session(what) | named)
    if isinstance(what, GravityDirection):
        down = factory.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", what.down.tolist(), strict=True)))
        rest = {"keyframe_id": what.keyframe_id, "down": down, "sigma_rad": what.sigma_rad}
        return _made(factory, "gravity", fields | _session(what) | rest)
    raise ConversionError(f"{type(what).__name__} is not known beside pixels")


class InputMessages:
    """Makes the messages of a stream: tracks name the cameras of the rig before them, guesses the fixed frame."""

    def __init__(self, factory: MessageFactory) -> None:
        self._factory = factory
        self._names: tuple[str, ...] = ()
        self._fixed_frame = ""

    def of(self, measurement: Measurement, stamp_ns: int) -> tuple[str, Any]:
        """Return the input and the message of a measurement."""
        if isinstance(measurement, CameraRig):
            self._names = measurement.names
            return "camera_rig", rig_message(self._factory, measurement, stamp_ns)
        if isinstance(measurement, Keyframe):
            self._fixed_frame = measurement.frame_id
            return "keyframes", keyframe_message(self._factory, measurement)
        if isinstance(measurement, LandmarkGuesses):
            return "landmark_guesses", guesses_message(self._factory, measurement, stamp_ns, self._fixed_frame)
        if isinstance(measurement, FeatureTracks):
            name = self._names[measurement.camera_index]
            return "feature_tracks", tracks_message(self._factory, measurement, stamp_ns, name)
        return side_message(self._factory, measurement, stamp_ns)


def _made(factory: MessageFactory, name: str, fields: dict[str, Any]) -> tuple[str, Any]:
    return name, factory.make(INPUT_TYPES[name], **fields)


def _session(what: RelativePose | LandmarkPriors | TrackMerge | GravityDirection) -> dict[str, Any]:
    return {"session_id": what.session_id}


# ``ba_msgs/RelativePose.LOOP``.
_LOOP = 1
_READERS: dict[str, Callable[[Any], Measurement]] = {
    INPUT_TYPES["keyframes"]: _keyframe,
    INPUT_TYPES["feature_tracks"]: _tracks,
    INPUT_TYPES["landmark_guesses"]: _guesses,
    INPUT_TYPES["relative_poses"]: _relative,
    INPUT_TYPES["landmark_priors"]: _priors,
    INPUT_TYPES["track_merges"]: _merge,
    INPUT_TYPES["gravity"]: _gravity,
    INPUT_TYPES["pose_prior"]: _pose_prior,
    INPUT_TYPES["gnss"]: _fix,
    INPUT_TYPES["camera_rig"]: lambda msg: rig_from_parts(str(msg.header.frame_id), msg.cameras, msg.body_from_camera),
    INPUT_TYPES["camera_info"]: lambda msg: rig_from_parts(str(msg.header.frame_id), [msg], None),
}
