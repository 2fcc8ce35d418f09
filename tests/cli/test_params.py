# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from ba_node.cli.main import main
from ba_node.config import Config, ConfigError, declarations
from ba_node.io.parameters import configure, parameters_yaml, read_parameters
from tools.generate_docs import parameters_table


def test_yaml_holds_every_parameter(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["params"]) == 0
    path = tmp_path / "all.yaml"
    path.write_text(capsys.readouterr().out)
    assert configure(path, {}) == Config()
    assert read_parameters(path) == Config().values()


def test_yaml_keeps_the_types_for_ros() -> None:
    tree = yaml.safe_load(parameters_yaml(Config()))["/**"]["ros__parameters"]
    for parameter in declarations():
        group, key = parameter.name.split(".")
        assert type(tree[group][key]) is parameter.kind, f"{parameter.name}: {tree[group][key]!r}"


def test_the_table_of_the_docs_has_a_row_for_every_parameter() -> None:
    rows = parameters_table(declarations()).splitlines()[2:]
    assert [row.split("`")[1] for row in rows] == [parameter.name for parameter in declarations()]


SEVERAL_NODES = """
/**: {ros__parameters: {window.max_keyframes: 9, solver.function_tolerance: 1.0e-5}}
/robot/ba_node: {ros__parameters: {window: {max_keyframes: 7}}}
other: {ros__parameters: {a: 1}}
"""


@pytest.mark.parametrize(
    "text",
    [
        "/**:\n  ros__parameters:\n    window: {max_keyframes: 7}\n    solver: {function_tolerance: 1e-5}\n",
        "/**:\n  ros__parameters: {use_sim_time: true, window.max_keyframes: 7, solver.function_tolerance: 1e-5}",
        "ba_node:\n  ros__parameters:\n    window.max_keyframes: 7\n    solver.function_tolerance: 1.0e-5\n",
        SEVERAL_NODES,
        "window:\n  max_keyframes: 7\nsolver:\n  function_tolerance: 1.0e-5\n",
        "window.max_keyframes: 7\nsolver.function_tolerance: 1.0e-5\n",
    ],
)
def test_every_form_of_file_is_read(text: str, tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(text)
    config = configure(path, {})
    assert config.window.max_keyframes == 7
    assert config.solver.function_tolerance == 1e-5


def test_single_changes_come_after_the_file(tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text("window: {max_keyframes: 7}")
    assert configure(path, {"window.max_keyframes": 9}).window.max_keyframes == 9


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("window: {max_keyframe: 7}", "did you mean 'window.max_keyframes'?"),
        ("window: {max_keyframes: 7.5}", "expected int, got float"),
        ("- 1\n- 2\n", "expected a mapping of parameters, got list"),
        ("a: [", "not YAML"),
        ("other:\n  ros__parameters: {a: 1}\n", "expected /** or ba_node"),
    ],
)
def test_bad_files_are_named(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        configure(path, {})
    assert words in str(error.value)
    assert str(error.value).startswith(str(path))


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no\.yaml: cannot be opened: No such file"):
        configure(tmp_path / "no.yaml", {})
