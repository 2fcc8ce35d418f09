# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Show the cameras of a rig, convert them from one form to another, publish them.

Read are our own YAML, Kalibr's camchain, camera_info of ROS's calibrator (one file a camera, the left one first), and
recordings (camera_rig; or camera_info, with extrinsics from p and r, or from /tf_static).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ba_node.cli import interrupts
from ba_node.cli.console import TargetError, facts, require_folder, write_result

if TYPE_CHECKING:
    from ba_node.measurements import CameraRig

EXAMPLE = "ba rig camchain.yaml --to own --out rig.yaml\n  ba rig left.yaml right.yaml --publish"
_FORMS = ("own", "kalibr", "camera_info")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE", help="YAML, or a recording")
    parser.add_argument("--to", choices=_FORMS, help="print it in this form")
    parser.add_argument(
        "--out", type=Path, nargs="+", metavar="FILE", help="write it there (camera_info: one a camera)"
    )
    parser.add_argument("--rectified", action="store_true", help="images are rectified: take p of camera_info, no d")
    parser.add_argument(
        "--base", default="", metavar="FRAME", help="body frame in /tf_static; the first camera if none"
    )
    parser.add_argument("--publish", action="store_true", help="publish it on camera_rig until interrupted")
    parser.add_argument("--namespace", default="", metavar="NS", help="where to publish it")


def run(args: argparse.Namespace) -> int:
    """Show, convert or publish."""
    import yaml  # noqa: PLC0415

    from ba_node.io.files import whole_file  # noqa: PLC0415
    from ba_node.io.rig_file import rig_yaml  # noqa: PLC0415
    from ba_node.offline.rig import load_rig  # noqa: PLC0415

    for path in args.out or ():
        require_folder(path)
    rig = load_rig(args.files, rectified=args.rectified, base=args.base)
    texts = rig_yaml(rig, args.to or "own")
    if args.out and len(args.out) != len(texts):
        raise TargetError(f"--out: {len(args.out)} files, expected {len(texts)}")
    for path, text in zip(args.out or (), texts, strict=False):
        with whole_file(path) as stream:
            stream.write(text.encode())
        print(f"written to {path}")
    if args.to and not args.out:
        print("---\n".join(texts), end="")
    if not args.to and not args.out:
        print(_shown(rig))
    write_result(args.json, yaml.safe_load(rig_yaml(rig, "own")[0]))
    if args.publish:
        from ba_node.ros.tools.play import publish_rig, take_leave  # noqa: PLC0415

        interrupts.at_interrupt(take_leave)
        publish_rig(rig, args.namespace, lambda topic: print(f"published on {topic} until interrupted", flush=True))
    return 0


def _shown(rig: CameraRig) -> str:
    """Return the cameras in words, with the distance of each from the first."""
    rows = [("body", rig.frame_id), ("cameras", str(len(rig)))]
    for i, name in enumerate(rig.names):
        fx, fy, cx, cy = rig.intrinsics[i]
        width, height = rig.image_size[i]
        lens = f"{rig.models[i] or 'no distortion'} {rig.distortion[i].round(6).tolist() or ''}".strip()
        apart = ((rig.position[i] - rig.position[0]) ** 2).sum() ** 0.5
        rows += [
            (name, f"{width} x {height} px, fx {fx:.3f}, fy {fy:.3f}, cx {cx:.3f}, cy {cy:.3f} px"),
            ("", lens),
            ("", f"at {rig.position[i].round(6).tolist()} m, turned {rig.orientation[i].round(6).tolist()} (x y z w)"),
        ]
        rows += [("", f"{apart:.6f} m from {rig.names[0]}")] if i else []
    return facts([*rows, *(("note", note) for note in rig.notes)])
