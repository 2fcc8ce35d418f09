# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn messages into arrays and arrays into messages, whatever library the messages come from.

Everything here works on attributes with the names of the ROS fields, so the classes of rclpy and the
dataclasses of rosbags are both served; how a message is made is left to a :class:`MessageFactory`.
Arrays are copied out of a message whole: no loop over tracks or points, and nothing that is kept
holds on to the buffer of a message or of a file.
"""

from __future__ import annotations

import dataclasses
import math
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
from ba_node.messages.camera_info import Lens, lens_of, unplaced
from ba_node.messages.factory import (
    ConversionError,
    MessageFactory,
    float32,
    header_message,
    numbers_message,
    pose_message,
    stamp_ns_from_message,
    uncertain_pose_message,
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


def _array(values: Any, dtype: Any = np.float64) -> NDArray[Any]:
    return np.array(values, dtype=dtype).reshape(-1)


def _integers(msg: Any, *names: str) -> dict[str, Any]:
    return {name: int(getattr(msg, name)) for name in names}


def _header(msg: Any) -> dict[str, Any]:
    return {"stamp_ns": stamp_ns_from_message(msg.header.stamp), "frame_id": str(msg.header.frame_id)}


def _pose(msg: Any) -> dict[str, Any]:
    """Return what a ``geometry_msgs/PoseWithCovariance`` says."""
    pose, covariance = msg.pose.pose, _array(getattr(msg.pose, "covariance", ()))
    return {"position": _xyz(pose.position), "orientation": _xyzw(pose.orientation), "covariance": covariance}


def _of_tracks(msg: Any, optional: tuple[str, ...] = (), **shapes: tuple[int, ...]) -> dict[str, Any]:
    """Return session, track ids, and columns with a row of a shape for each of them.

    Where one has another length all are empty, and ``malformed`` says so. Optional ones may be empty alone.
    """
    read = {name: _array(getattr(msg, name), np.uint64 if name in _IDS else np.float64) for name in shapes}
    track_id, wrong = _array(msg.track_id, np.uint64), []
    for name, values in read.items():
        width = math.prod(shapes[name])
        if len(values) != width * len(track_id) and (len(values) or name not in optional):
            each = f": expected {width} for each track" if width > 1 else ""
            wrong.append(f"{name} has {len(values)} entries, track_id {len(track_id)}{each}")
    end = 0 if wrong else None
    columns = {name: values[:end].reshape(-1, *shapes[name]) for name, values in read.items()}
    return {"track_id": track_id[:end], **columns, "malformed": "; ".join(wrong)} | _integers(msg, "session_id")


def _keyframe(msg: Any) -> Keyframe:
    pose = _pose(msg)
    # All zeros stand for unknown.
    pose["covariance"] = pose["covariance"] if pose["covariance"].any() else np.empty(0)
    return Keyframe(**_integers(msg, "session_id", "keyframe_id"), **_header(msg), **pose)


def _tracks(msg: Any) -> FeatureTracks:
    read = _of_tracks(msg, ("sigma_px", "depth_m"), u=(), v=(), sigma_px=(), depth_m=())
    uv = np.empty((len(read["u"]), 2))
    uv[:, 0], uv[:, 1] = read.pop("u"), read.pop("v")
    return FeatureTracks(**_integers(msg, "keyframe_id", "camera_index"), uv=uv, **read)


def _relative(msg: Any) -> RelativePose:
    ids = _integers(msg, "session_id", "from_keyframe_id", "to_keyframe_id")
    return RelativePose(**ids, is_loop=int(msg.kind) == _LOOP, **_pose(msg))


def _priors(msg: Any) -> LandmarkPriors:
    return LandmarkPriors(frame_id=str(msg.header.frame_id), **_of_tracks(msg, position=(3,), covariance=(3, 3)))


def _gravity(msg: Any) -> GravityDirection:
    ids = _integers(msg, "session_id", "keyframe_id")
    return GravityDirection(**ids, down=_xyz(msg.down), sigma_rad=float(msg.sigma_rad))


def _fix(msg: Any) -> GlobalFix:
    geodetic = np.array([msg.latitude, msg.longitude, msg.altitude], dtype=np.float64)
    return GlobalFix(
        **_header(msg),
        geodetic=geodetic,
        covariance=_array(msg.position_covariance),
        is_fix=int(msg.status.status) >= 0,
    )


def rig_from_parts(frame_id: str, cameras: Sequence[Any], poses: Sequence[Any] | None) -> CameraRig:
    """Return the rig; without poses the cameras sit at the origin of the body."""
    names, read = [str(info.header.frame_id) for info in cameras], [_lens(info) for info in cameras]
    wrong = [f"camera {i} ({names[i]!r}): {why}" for i, (_, why) in enumerate(read) if why]
    if poses is not None and len(poses) != len(cameras):
        counts = f"cameras has {len(cameras)} entries, body_from_camera {len(poses)}"
        wrong.insert(0, f"{counts}: expected one pose for each camera")
    rig = unplaced(frame_id, names, [str(info.distortion_model) for info in cameras], [lens for lens, _ in read])
    if wrong:
        return dataclasses.replace(rig, malformed=wrong[0])
    if not poses:
        return rig
    position, orientation = zip(*((_xyz(pose.position), _xyzw(pose.orientation)) for pose in poses), strict=True)
    return dataclasses.replace(rig, position=np.array(position), orientation=np.array(orientation))


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


def input_message(
    factory: MessageFactory, measurement: Measurement, stamp_ns: int = 0, frame_id: str = ""
) -> tuple[str, Any]:
    """Return the input and the message of a measurement.

    ``stamp_ns`` and ``frame_id`` are for those that name none: tracks are in the optical frame of their camera, guesses
    in the fixed frame.
    """
    name, fields = _WRITERS[type(measurement)]
    stamp_ns, frame_id = getattr(measurement, "stamp_ns", stamp_ns), getattr(measurement, "frame_id", frame_id)
    header = header_message(factory, stamp_ns, frame_id)
    return name, factory.make(INPUT_TYPES[name], header=header, **fields(factory, measurement, stamp_ns))


def _plain(factory: MessageFactory, what: Any, *but: str) -> dict[str, Any]:
    """Return the fields that a message has by the same name: integers, numbers, and flat arrays."""
    values = {name: value for name, value in vars(what).items() if name not in (*_SAID_BY_HEADER, *but)}
    return {name: factory.array(v.reshape(-1)) if isinstance(v, np.ndarray) else v for name, v in values.items()}


def _with_pose(factory: MessageFactory, what: Keyframe | RelativePose | PosePrior, *_: Any) -> dict[str, Any]:
    covariance = what.covariance if len(what.covariance) else np.zeros(36)
    pose = uncertain_pose_message(factory, what.position, what.orientation, covariance)
    fields = _plain(factory, what, "position", "orientation", "covariance", "is_loop")
    return fields | {"pose": pose} | ({"kind": int(what.is_loop)} if isinstance(what, RelativePose) else {})


def _tracks_fields(factory: MessageFactory, tracks: FeatureTracks, *_: Any) -> dict[str, Any]:
    columns = {"u": tracks.uv[:, 0], "v": tracks.uv[:, 1], "sigma_px": tracks.sigma_px, "depth_m": tracks.depth_m}
    return _plain(factory, tracks, "uv") | {name: factory.array(float32(column)) for name, column in columns.items()}


def _gravity_fields(factory: MessageFactory, what: GravityDirection, *_: Any) -> dict[str, Any]:
    return _plain(factory, what) | {"down": numbers_message(factory, "geometry_msgs/msg/Vector3", what.down)}


def _fix_fields(factory: MessageFactory, fix: GlobalFix, *_: Any) -> dict[str, Any]:
    return {
        **dict(zip(("latitude", "longitude", "altitude"), fix.geodetic.tolist(), strict=True)),
        "status": factory.make("sensor_msgs/msg/NavSatStatus", status=0 if fix.is_fix else -1, service=1),
        "position_covariance": factory.fixed(fix.covariance),
        "position_covariance_type": 3,
    }


def _rig_fields(factory: MessageFactory, rig: CameraRig, stamp_ns: int) -> dict[str, Any]:
    poses = [pose_message(factory, p, q) for p, q in zip(rig.position, rig.orientation, strict=True)]
    cameras = [_camera_info(factory, rig, index, stamp_ns) for index in range(len(rig))]
    return {"cameras": cameras, "body_from_camera": poses}


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


class InputMessages:
    """Makes the messages of a stream: tracks name the cameras of the rig before them, guesses the fixed frame."""

    def __init__(self, factory: MessageFactory) -> None:
        self._factory = factory
        self._names: tuple[str, ...] = ()
        self._fixed_frame = ""

    def of(self, measurement: Measurement, stamp_ns: int) -> tuple[str, Any]:
        """Return the input and the message of a measurement."""
        frame_id = ""
        if isinstance(measurement, CameraRig):
            self._names = measurement.names
        elif isinstance(measurement, Keyframe):
            self._fixed_frame = measurement.frame_id
        elif isinstance(measurement, LandmarkGuesses):
            frame_id = self._fixed_frame
        elif isinstance(measurement, FeatureTracks):
            frame_id = self._names[measurement.camera_index]
        return input_message(self._factory, measurement, stamp_ns, frame_id)


# ``ba_msgs/RelativePose.LOOP``.
_LOOP = 1
_IDS = ("same_as",)
# What messages hold in their header, or not at all.
_SAID_BY_HEADER = ("stamp_ns", "frame_id", "malformed")
_READERS: dict[str, Callable[[Any], Measurement]] = {
    INPUT_TYPES["keyframes"]: _keyframe,
    INPUT_TYPES["feature_tracks"]: _tracks,
    INPUT_TYPES["landmark_guesses"]: lambda msg: LandmarkGuesses(**_of_tracks(msg, position=(3,))),
    INPUT_TYPES["relative_poses"]: _relative,
    INPUT_TYPES["landmark_priors"]: _priors,
    INPUT_TYPES["track_merges"]: lambda msg: TrackMerge(**_of_tracks(msg, same_as=())),
    INPUT_TYPES["gravity"]: _gravity,
    INPUT_TYPES["pose_prior"]: lambda msg: PosePrior(**_header(msg), **_pose(msg)),
    INPUT_TYPES["gnss"]: _fix,
    INPUT_TYPES["camera_rig"]: lambda msg: rig_from_parts(str(msg.header.frame_id), msg.cameras, msg.body_from_camera),
    INPUT_TYPES["camera_info"]: lambda msg: rig_from_parts(str(msg.header.frame_id), [msg], None),
}
# Input of each kind of measurement, and the fields of its message but for the header.
_WRITERS: dict[type, tuple[str, Callable[[MessageFactory, Any, int], dict[str, Any]]]] = {
    Keyframe: ("keyframes", _with_pose),
    FeatureTracks: ("feature_tracks", _tracks_fields),
    LandmarkGuesses: ("landmark_guesses", lambda factory, what, _: _plain(factory, what)),
    RelativePose: ("relative_poses", _with_pose),
    LandmarkPriors: ("landmark_priors", lambda factory, what, _: _plain(factory, what)),
    TrackMerge: ("track_merges", lambda factory, what, _: _plain(factory, what)),
    GravityDirection: ("gravity", _gravity_fields),
    PosePrior: ("pose_prior", _with_pose),
    GlobalFix: ("gnss", _fix_fields),
    CameraRig: ("camera_rig", _rig_fields),
}
