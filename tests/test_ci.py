# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The workflow and the hooks are files that are read, of commands that are there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from tools.env_checks import SUPPORTED

ROOT = Path(__file__).resolve().parent.parent
WORKFLOW = ROOT / ".github" / "workflows" / "ci.yml"


def jobs() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(WORKFLOW.read_text())["jobs"]
    return found


def hooks() -> list[dict[str, Any]]:
    repositories = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert [repository["repo"] for repository in repositories] == ["local"]
    found: list[dict[str, Any]] = repositories[0]["hooks"]
    return found


@pytest.mark.parametrize("schema", ["vendor.github-workflows", "custom.github-workflows-require-timeout"])
def test_the_workflow_fits_its_schema(schema: str) -> None:
    pytest.importorskip("check_jsonschema", reason="check-jsonschema is not installed (requirements/dev.txt)")
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", schema, str(WORKFLOW)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr


def test_every_python_is_tested() -> None:
    (_, oldest), (_, newest) = SUPPORTED
    supported = [f"3.{minor}" for minor in range(oldest, newest + 1)]
    for job in ("test", "wheels"):
        assert jobs()[job]["strategy"]["matrix"]["python"] == supported


def test_every_command_of_make_is_there() -> None:
    targets = set(re.findall(r"^(\w[\w-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    texts = [step.get("run", "") for job in jobs().values() for step in job["steps"]]
    texts += [(ROOT / ".ci" / "run").read_text()]
    called = {
        word
        for text in texts
        for line in re.findall(r"^\s*make (.*)$", text, re.MULTILINE)
        for word in line.split()
        if "=" not in word
    }
    assert {"lint", "test-all", "sanitize"} <= called <= targets, f"no such target: {called - targets}"


def test_hooks_call_tools_of_the_environment() -> None:
    pinned = (ROOT / "requirements" / "dev.txt").read_text()
    for hook in hooks():
        program, *arguments = hook["entry"].removeprefix(".venv/bin/python -m ").split()
        module = program.removeprefix(".venv/bin/")
        assert hook["entry"].startswith(".venv/bin/"), hook
        assert hook["language"] == "system", hook
        assert re.search(rf"^{module.replace('_', '.')}==", pinned, re.MULTILINE), f"{module} is not pinned"
        paths = [argument for argument in arguments if "/" in argument]
        assert all((ROOT / path).exists() for path in paths), hook
