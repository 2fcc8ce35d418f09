# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Convert recordings, maps, reconstructions and trajectories between formats, both ways.

  in:   recording (.mcap, .db3, folder), map (.npz), COLMAP model (folder, text or binary), Bundler (.out), BAL (.txt,
        .bz2, .gz), g2o (.g2o, bundle problem or pose graph); points (.ply); poses as TUM, KITTI, EuRoC (.csv)
  out:  recording (.mcap), COLMAP model (folder), Bundler (.out), BAL (.txt, .bz2, .gz), g2o (.g2o; poses alone where
        cameras have a distortion), points (.ply); poses as TUM (.tum), KITTI (.kitti)

A recording comes out as the back-end refines it with its defaults, as in `ba replay`. A recording that is made has each
image as a keyframe, 0.1 s apart, its points as landmark guesses and its ids as the indices in the file; pixels are
float32 in the messages. Points alone become guesses of landmarks. Pixels of COLMAP count from the corner of the image,
those here from the middle of the first pixel: half a pixel is added and taken away.

With --from, IN is a recording of what another front-end published, and OUT its keyframes and tracks: openvins
(loop_pose, loop_feats, loop_extrinsic, loop_intrinsics), vins_fusion (keyframe_pose, keyframe_point, extrinsic),
vins_mono (feature, keyframe_pose or odometry, extrinsic), rtabmap (odom, odom_info; without these mapData, which is
rtabmap_map). --topic then names these. Exit code 3: messages were there that could not be read.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ba_node.cli import console

EXAMPLE = (
    "ba convert sparse/0 scene.mcap\n  ba convert bags/stereo_loop.mcap model/\n"
    "  ba convert problem-49-7776-pre.txt ladybug.mcap\n  ba convert out/trajectory.tum poses.txt --to kitti\n"
    "  ba convert openvins.mcap keyframes.mcap --from openvins"
)
NEEDS_A_LOOK = 3
# What no sound recording of another front-end has.
_FAULTS = (
    "malformed",
    "undecodable",
    "inexact_id",
    "not_finite",
    "bad_camera",
    "unknown_camera",
    "bad_pose",
    "bad_extrinsic",
    "not_pixels",
    "misread",
)
# A few wait for a partner where a recording begins and ends, as a share of the images.
_MOST_APART = 0.1
_FORMATS = ("mcap", "colmap", "colmap-text", "bundler", "bal", "tum", "kitti", "g2o", "ply")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", type=Path, metavar="IN")
    parser.add_argument("target", type=Path, metavar="OUT")
    parser.add_argument("--to", choices=_FORMATS, help="format of OUT, where its name does not tell it")
    console.add_topic_options(parser)
    _add_front_end_options(parser.add_argument_group("recordings of other front-ends"))


def _add_front_end_options(parser: argparse._ArgumentGroup) -> None:
    from ba_node.messages.adapters import SOURCES  # noqa: PLC0415  # slow to import

    parser.add_argument("--from", dest="front_end", choices=SOURCES, help="which of them it is")
    parser.add_argument("--rig", type=Path, nargs="+", metavar="FILE", help="cameras, in any form that ba rig reads")
    parser.add_argument("--tolerance", type=float, default=1e-3, metavar="S", help="stamps pair within (%(default)s)")
    parser.add_argument("--parallax", type=float, default=1.0, metavar="DEG", help="between keyframes (%(default)s)")
    parser.add_argument("--cameras", type=int, default=0, metavar="N", help="NUM_OF_CAM of vins_mono (rig's, or 1)")


def run(args: argparse.Namespace) -> int:
    """Convert."""
    if args.front_end:
        return _convert_front_end(args)
    from ba_node.io.reference import is_kitti  # noqa: PLC0415
    from ba_node.offline import convert  # noqa: PLC0415

    form = convert.format_of(args.target, args.to)
    console.require_folder(args.target)
    if form == "mcap":
        console.require_mcap(args.target)
    with console.progress_bar("convert", "messages") as progress:
        what = convert.read(args.source, console.topic_choice(args), progress)
    left_out = convert.write(args.target, what, form)
    print(f"{args.target}: {convert.counts(what)}{f', without {left_out}' if left_out else ''}")
    if form == "tum" and is_kitti(args.source):
        print("  stamps are a second apart, as KITTI has none: put those of the images in their place")
    console.write_result(args.json, {"target": args.target.name, "content": convert.counts(what), "left_out": left_out})
    return 0


def _convert_front_end(args: argparse.Namespace) -> int:
    from ba_node.messages.adapters import AdapterOptions  # noqa: PLC0415
    from ba_node.offline.adapt import adapt  # noqa: PLC0415
    from ba_node.offline.rig import load_rig  # noqa: PLC0415

    console.require_mcap(args.target)
    topics = dict(text.split("=", 1) for text in args.topic if "=" in text)
    if len(topics) < len(args.topic):
        raise console.TargetError(f"--topic {' '.join(args.topic)}: expected NAME=TOPIC, each name once")
    for name, least in (("tolerance", 0.0), ("parallax", 0.0), ("cameras", 0)):
        if not least <= getattr(args, name) < float("inf"):
            raise console.TargetError(f"--{name} {getattr(args, name):g}: expected a number, {least:g} or more")
    rig = load_rig(args.rig) if args.rig else None
    options = AdapterOptions(args.tolerance, args.parallax, rig=rig)
    adapter = adapt(args.source, args.target, args.front_end, options, args.cameras or (len(rig) if rig else 1), topics)
    print(f"{args.target}: {adapter.summary()}")
    left_out = dict(sorted(adapter.counted.items()))
    result = {"keyframes": adapter.sent, "images": adapter.images, "left_out": left_out, "notes": adapter.told()}
    console.write_result(args.json, {"target": args.target.name, **result})
    for note in adapter.told():
        print(f"  {note}")
    # Stamps that are all alike leave one keyframe, and are counted as that coming again.
    few = adapter.sent < max(2, adapter.counted["repeated_keyframe"])
    # Poses and images that both found no partner have stamps that do not fit.
    apart = min(adapter.counted["no_pose"], adapter.counted["no_features"]) > _MOST_APART * adapter.images
    return NEEDS_A_LOOK if few or apart or any(adapter.counted[reason] for reason in _FAULTS) else 0
