# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""`ba tune --apply` sets what was found on a running node."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.srv import GetParameters

from ba_node.cli.main import main
from ba_node.config import Config
from ba_node.offline.tuning_page import write_parameters

pytestmark = pytest.mark.dds


@pytest.mark.slow
def test_what_was_found_is_set_on_a_running_node(
    start_node: Callable[..., Any], make_peer: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    start_node()
    peer = make_peer()
    peer.connect()
    wanted = {"window.max_keyframes": 7, "tracks.outlier_px": 3.25}
    write_parameters(tmp_path, Config(), wanted)
    assert main(["tune", "--apply", "/ba_node", "--out", str(tmp_path)]) == 0
    assert "/ba_node: window.max_keyframes = 7" in capsys.readouterr().out
    values = peer.call(GetParameters, "ba_node/get_parameters", GetParameters.Request(names=list(wanted))).values
    assert (values[0].integer_value, values[1].double_value) == (7, 3.25)
    # All or none: a window of more keyframes than this node keeps.
    assert peer.set("scene.max_keyframes", 100).successful
    write_parameters(tmp_path, Config(), {"window.max_keyframes": 4000, "tracks.outlier_px": 9.0})
    assert main(["tune", "--apply", "/ba_node", "--out", str(tmp_path)]) == 2
    assert "ba: error: /ba_node: refuses: parameter window.max_keyframes = 4000" in capsys.readouterr().err
    values = peer.call(GetParameters, "ba_node/get_parameters", GetParameters.Request(names=list(wanted))).values
    assert (values[0].integer_value, values[1].double_value) == (7, 3.25)


def test_a_node_that_is_not_there_is_named(
    domain: int,  # noqa: ARG001
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ba_node.ros.tools.set_parameters._FIND_S", 0.5)
    write_parameters(tmp_path, Config(), {"window.max_keyframes": 7})
    assert main(["tune", "--apply", "/nobody", "--out", str(tmp_path)]) == 2
    assert "/nobody: no such node answers" in capsys.readouterr().err
    assert main(["tune", "--apply", "/nobody", "--out", str(tmp_path / "none")]) == 2
