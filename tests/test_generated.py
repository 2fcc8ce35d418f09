# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Generated files are as the generator writes them, and say what the code does."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from ba_node.config import Config
from ba_node.core.methods import METHODS
from ba_node.io.parameters import configure

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate_docs", ROOT / "tools" / "generate_docs.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    "name",
    [
        "config/ba_front_end.yaml",
        "config/ba_node.yaml",
        "docs/front_end.md",
        "docs/methods.md",
        "docs/parameters.md",
        "docs/robustness.md",
        "docs/thesis.md",
        "docs/topics.md",
    ],
)
def test_file_is_up_to_date(name: str, generator: ModuleType) -> None:
    assert (ROOT / name).read_text() == generator.pages()[name], f"{name} is stale: run {generator.MADE_BY}"


def test_check_is_quiet_when_all_is_up_to_date(generator: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert generator.main(["--check"]) == 0
    assert capsys.readouterr().out == ""


def test_shipped_yaml_holds_the_defaults() -> None:
    assert configure(ROOT / "config" / "ba_node.yaml", {}) == Config()


def test_every_method_is_described() -> None:
    text = (ROOT / "docs" / "methods.md").read_text()
    assert [name for name in METHODS if f"`{name}`" not in text] == []
