# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The shipped recordings are what bags/README.md says."""

from __future__ import annotations

import hashlib
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.io.bag_reader import BagReader

BAGS = Path(__file__).parents[1] / "bags"
README = (BAGS / "README.md").read_text()
COMMANDS = [shlex.split(line)[1:] for line in re.findall(r"^ {4}(ba synth .*)$", README, re.MULTILINE)]


def test_every_recording_is_described_and_they_are_small() -> None:
    recordings = sorted(BAGS.glob("*.mcap"))
    assert len(recordings) >= 2
    assert {path.name for path in recordings} == {command[1] for command in COMMANDS}
    size = sum(path.stat().st_size for path in recordings)
    assert size < 3_000_000, f"{size} bytes together"


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[1])
def test_checksum_is_the_one_in_the_readme(command: list[str]) -> None:
    section = README.split(f"## {command[1]}")[1].split("\n## ")[0]
    written = re.findall(r"sha256 `([0-9a-f]{64})`", section)
    assert written == [hashlib.sha256((BAGS / command[1]).read_bytes()).hexdigest()]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[1])
def test_the_command_in_the_readme_makes_the_recording(command: list[str], tmp_path: Path) -> None:
    """Message for message; the compressed bytes may differ with the version of zstd."""
    made = tmp_path / command[1]
    assert main([command[0], str(made), *command[2:]]) == 0
    with BagReader(BAGS / command[1]) as shipped, BagReader(made) as again:
        expected, found = list(shipped.measurements()), list(again.measurements())
        assert shipped.topics == again.topics
    assert len(expected) == len(found) > 80
    for (topic, stamp_ns, a), (other_topic, other_stamp_ns, b) in zip(expected, found, strict=True):
        assert (topic, stamp_ns, type(a)) == (other_topic, other_stamp_ns, type(b))
        for name, value in vars(a).items():
            # Another version of the C library may round the last digit of a sine otherwise.
            if isinstance(value, np.ndarray) and value.dtype == np.float64:
                np.testing.assert_allclose(vars(b)[name], value, rtol=1e-6, atol=1e-9, err_msg=f"{topic} {name}")
            else:
                np.testing.assert_array_equal(vars(b)[name], value, err_msg=f"{topic} {name}")
