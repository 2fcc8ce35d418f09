# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What the views in config/ show exists: topics, their quality of service, fields and namespaces."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from ba_node.estimate import SolveReport
from ba_node.io.parameters import NODE_NAME
from ba_node.messages.markers import NAMESPACES
from ba_node.messages.outputs import POINT_DTYPE
from ba_node.messages.report import LatencyReport, QueueReport
from ba_node.messages.topics import TOPICS as DECLARED
from ba_node.messages.topics import Delivery

CONFIG = Path(__file__).resolve().parent.parent / "config"
TOPICS = {topic.given_name.replace("~", f"/{NODE_NAME}"): topic for topic in DECLARED.values()}
# The message that a display of rviz shows.
SHOWS = {
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "Path": "nav_msgs/msg/Path",
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
}


def displays() -> list[dict[str, Any]]:
    rviz = yaml.safe_load((CONFIG / "ba_node.rviz").read_text())
    return [display for display in rviz["Visualization Manager"]["Displays"] if "Topic" in display]


def strings(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        for key, value in node.items():
            yield from (key, *strings(value))
    elif isinstance(node, list):
        for value in node:
            yield from strings(value)
    elif isinstance(node, str):
        yield node


@pytest.mark.parametrize("display", displays(), ids=lambda display: display["Name"])
def test_rviz_shows_what_is_published(display: dict[str, Any]) -> None:
    topic = display["Topic"]["Value"]
    assert TOPICS[topic].type_name == SHOWS[display["Class"].split("/")[1]]
    kept = display["Topic"]["Durability Policy"] == "Transient Local"
    assert kept == (TOPICS[topic].delivery is Delivery.LATCHED)


def test_rviz_shows_every_namespace_and_an_existing_field() -> None:
    by_name = {display["Name"]: display for display in displays()}
    assert tuple(by_name["Markers"]["Namespaces"]) == NAMESPACES
    assert POINT_DTYPE.names is not None
    assert by_name["Points"]["Channel Name"] in POINT_DTYPE.names


def test_foxglove_shows_what_is_published() -> None:
    layout = json.loads((CONFIG / "foxglove_layout.json").read_text())
    named = {text.split(".")[0] for text in strings(layout) if text.startswith("/")}
    assert named <= set(TOPICS), named - set(TOPICS)
    assert {f"/{NODE_NAME}/{topic}" for topic in ("points", "path", "markers", "report")} | {"/diagnostics"} <= named
    fields = {text.split(".")[1] for text in strings(layout) if re.match(rf"/{NODE_NAME}/report\.", text)}
    assert fields <= {
        field.name for part in (SolveReport, QueueReport, LatencyReport) for field in dataclasses.fields(part)
    }
    assert fields


def test_every_panel_of_the_foxglove_layout_has_a_place() -> None:
    layout = json.loads((CONFIG / "foxglove_layout.json").read_text())
    placed = {text for text in strings(layout["layout"]) if "!" in text}
    assert placed == set(layout["configById"])


def test_the_library_of_foxglove_knows_every_setting_of_the_layout() -> None:
    layouts = pytest.importorskip("foxglove.layouts", reason="needs foxglove-sdk")
    """A setting that the app does not know is passed over in silence."""
    configs = {
        "3D": layouts.ThreeDeeConfig,
        "Plot": layouts.PlotConfig,
        "DiagnosticSummary": layouts.DiagnosticsSummaryConfig,
        "RawMessages": layouts.RawMessagesConfig,
    }
    topics = {
        "PointCloud2": layouts.BaseRendererPointCloudTopicSettings,
        "Path": layouts.BaseRendererPosesTopicSettings,
        "MarkerArray": layouts.BaseRendererRosMarkerTopicSettings,
        "PoseWithCovarianceStamped": layouts.BaseRendererPoseTopicSettings,
    }

    def unknown(given: dict[str, Any], config: Any) -> set[str]:
        return set(given) - set(config()._to_dict()) - {"foxglovePanelTitle"}

    panels = json.loads((CONFIG / "foxglove_layout.json").read_text())["configById"]
    for name, panel in panels.items():
        assert not unknown(panel, configs[name.split("!")[0]]), name
        for topic, settings in panel.get("topics", {}).items():
            kind = TOPICS[topic].type_name.rpartition("/")[2]
            assert not unknown(settings, topics[kind]), topic
        for series in panel.get("paths", ()):
            assert not unknown(series, lambda: layouts.PlotSeries(value="")), name
    assert not unknown(panels["3D!map"]["cameraState"], layouts.ThreeDeeCameraState)
