# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What docs/fleet.md says of clusters, tried: machines reached by SSH, and the commands of the Kubernetes manifest."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from ba_node import __version__
from ba_node.cli.main import main
from ba_node.offline.fleet import Fleet

ROOT = Path(__file__).resolve().parents[2]
MONO = ROOT / "bags" / "mono_loop.mcap"
MANIFEST = ROOT / "examples" / "kubernetes.yaml"
PORT = "18786"
distributed = pytest.importorskip("distributed", reason="needs dask.distributed: pip install ba_node[fleet]")


@contextmanager
def machines(home: Path, *names: str) -> Iterator[None]:
    """Have an SSH server answer to some names, with keys and config below a home; what ran in it ends with it."""
    pytest.importorskip("asyncssh", reason="needs asyncssh")
    command = [sys.executable, str(Path(__file__).with_name("ssh_server.py")), str(home), *names]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, start_new_session=True, **pipes) as server:
        try:
            assert server.stdout is not None
            assert server.stdout.readline() == b"listening\n"
            yield
        finally:
            os.killpg(server.pid, signal.SIGKILL)


def code_of(page: str) -> str:
    """Return the block of Python of a page."""
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL)
    return str(block)


@contextmanager
def dask(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command of Dask while the block runs."""
    with subprocess.Popen([sys.executable, "-m", *arguments], stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.terminate()


def workers(address: str, expected: int) -> int:
    """Return how many workers a scheduler has, once there are so many or 30 s have gone."""
    end = time.monotonic() + 30.0
    while True:
        with Fleet(scheduler=address) as fleet:
            if fleet.size == expected or time.monotonic() > end:
                return fleet.size
        time.sleep(0.2)


def checked(address: str, tmp_path: Path) -> int:
    """Check two recordings on a cluster."""
    other = shutil.copy(MONO, tmp_path / "other.mcap")
    return main(["check", str(MONO), str(other), "--scheduler", address])


@pytest.mark.slow
def test_machines_are_reached_by_ssh_as_the_page_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three names in ~/.ssh/config lead to one server; the page's program runs as it stands, but for fewer workers."""
    program = code_of("fleet.md").replace('"n_workers": 8', '"n_workers": 1')
    assert '["head", "node1", "node2"]' in program and '"n_workers": 1' in program
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    environment = {**os.environ, "HOME": str(tmp_path)}
    with (
        machines(tmp_path, "head", "node1", "node2"),
        subprocess.Popen([sys.executable, "-c", program], env=environment, text=True, **pipes) as cluster,
    ):
        assert cluster.stdin is not None and cluster.stdout is not None
        address = cluster.stdout.readline().strip()
        assert workers(address, 2) == 2
        assert checked(address, tmp_path) == 0
        cluster.communicate("\n", timeout=60)
        assert cluster.returncode == 0
    assert f"{MONO}: ok" in capsys.readouterr().out


def test_the_manifest_is_one_of_kubernetes() -> None:
    kubernetes = pytest.importorskip("kubernetes_validate", reason="needs kubernetes-validate")
    parts = list(yaml.safe_load_all(MANIFEST.read_text()))
    assert [part["kind"] for part in parts] == ["Service", "Deployment", "Deployment"]
    for part in parts:
        kubernetes.validate(part, "1.30", strict=True)
    scheduler, worker = (part["spec"]["template"] for part in parts[1:])
    assert parts[0]["spec"]["selector"] == scheduler["metadata"]["labels"] != worker["metadata"]["labels"]
    for part in (scheduler, worker):
        (container,) = part["spec"]["containers"]
        assert container["image"].endswith(f"/ba_node:{__version__}")


@pytest.mark.slow
def test_the_commands_of_the_manifest_make_a_cluster(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        " ".join(part["spec"]["template"]["spec"]["containers"][0]["args"])
        for part in list(yaml.safe_load_all(MANIFEST.read_text()))[1:]
    ]
    with ExitStack() as stack:
        for line in words:
            here = line.replace("ba-scheduler", "127.0.0.1").replace("8786", PORT)
            stack.enter_context(dask(*here.split(), "--no-dashboard"))
        with distributed.Client(f"tcp://127.0.0.1:{PORT}", timeout=60) as client:
            client.wait_for_workers(1, timeout=60)
        assert checked(f"tcp://127.0.0.1:{PORT}", tmp_path) == 0
    assert f"{MONO}: ok" in capsys.readouterr().out
