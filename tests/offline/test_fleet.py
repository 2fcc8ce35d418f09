# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Many recordings: on a cluster of two real processes, one of which is killed; bad ones fail alone."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ba_node.cli.main import main
from ba_node.io.bag_files import same_recording
from ba_node.offline import batch
from ba_node.offline.fleet import Fleet, FleetError, expand, name_of

BAGS = Path(__file__).resolve().parents[2] / "bags"
MONO, STEREO = BAGS / "mono_loop.mcap", BAGS / "stereo_loop.mcap"
_START_S = 60.0


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Return a Dask cluster of two processes."""
    distributed = pytest.importorskip("distributed", reason="needs dask.distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50) as made:
        yield made


@pytest.fixture
def broken(tmp_path: Path) -> Path:
    path = tmp_path / "broken.mcap"
    path.write_bytes(MONO.read_bytes()[:3000])
    return path


@pytest.mark.slow
def test_two_fleets_at_once_do_not_ask_for_the_same_port() -> None:
    """Dask's own choice is 8787, with a warning where somebody has it; warnings fail a test."""
    pytest.importorskip("distributed", reason="needs dask.distributed")
    with Fleet(jobs=2) as one, Fleet(jobs=2) as other:
        assert one.size == other.size == 2


@pytest.mark.slow
def test_a_killed_worker_costs_nothing_but_time(cluster: Any, broken: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    copies = [shutil.copy(MONO, tmp_path / f"{name}.mcap") for name in ("north", "south", "west")]
    out, codes = tmp_path / "out", []
    arguments = ["replay", *map(str, copies), str(broken), "--out", str(out), "--scheduler", cluster.scheduler_address]
    thread = threading.Thread(target=lambda: codes.append(main([*arguments, "--no-report"])))
    with distributed.Client(cluster.scheduler_address) as client:
        before = set(client.run(os.getpid).values())
        assert len(before) == 2
        thread.start()
        begun = time.monotonic()
        while not list(out.glob("*/.refined.mcap.*.partial")):
            assert time.monotonic() - begun < _START_S, "no replay has begun"
            time.sleep(0.005)
        for process in before:
            os.kill(process, signal.SIGKILL)
        thread.join(timeout=120)
        assert codes == [3], "the broken one is to be looked at, and nothing else"
        client.wait_for_workers(2, timeout=60)
        assert not before & set(client.run(os.getpid).values())
    rows = {Path(row["recording"]).stem: row for row in json.loads((out / "results.json").read_text())["recordings"]}
    assert [rows[name]["state"] for name in ("north", "south", "west", "broken")] == ["ok", "ok", "ok", "failed"]
    assert "truncated after 0 messages" in rows["broken"]["note"]
    assert main(["replay", str(MONO), "--out", str(tmp_path / "alone"), "--no-report"]) == 0
    for name in ("north", "south", "west"):
        trajectory = (out / name / "trajectory.tum").read_bytes()
        assert trajectory == (tmp_path / "alone" / "trajectory.tum").read_bytes(), name


@pytest.mark.slow
def test_what_kills_every_worker_is_given_up_and_named(cluster: Any) -> None:
    with Fleet(scheduler=cluster.scheduler_address) as fleet:
        assert fleet.size == 2
        found = dict(fleet.each(os._exit, [1], lambda task, words: (task, words)))
    assert found == {0: (1, "3 workers died of it, perhaps for want of memory (KilledWorker)")}


def test_one_process_tells_of_each_recording_as_it_is_done() -> None:
    begun: list[int] = []
    with Fleet() as fleet:
        for number, _ in fleet.each(begun.append, [0, 1, 2], lambda *_: None):
            assert begun == list(range(number + 1)), "the next one has begun before this one was told of"
    assert len(begun) == 3


@pytest.mark.slow
def test_results_are_one_table_and_page(broken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("plotly", reason="needs plotly: pip install ba_node[report]")
    out = tmp_path / "out"
    assert main(["replay", str(MONO), str(broken), str(STEREO), "--out", str(out), "--no-report"]) == 3
    shown = capsys.readouterr()
    assert f"ba: error: {broken}: no message can be read" in shown.err
    assert [line.split()[1] for line in shown.out.splitlines()[1:4]] == ["ok", "failed", "ok"]
    with (out / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["error_after_m"]) for row in (rows[0], rows[2])] == pytest.approx([0.0082, 0.0053], rel=0.05)
    page = (out / "index.html").read_text()
    assert "3 recordings: 2 sound, 0 to look at, 1 failed" in page


@pytest.mark.slow
def test_resumed_replays_are_not_done_again(tmp_path: Path) -> None:
    other = shutil.copy(MONO, tmp_path / "other.mcap")
    arguments = ["replay", str(MONO), str(other), "--out", str(tmp_path / "out"), "--no-report", "--resume"]
    assert main(arguments) == 0
    stamp = (tmp_path / "out" / "other" / "report.json").stat().st_mtime_ns
    (tmp_path / "out" / "mono_loop" / "report.json").unlink()
    assert main(arguments) == 0
    assert (tmp_path / "out" / "mono_loop" / "report.json").is_file()
    assert (tmp_path / "out" / "other" / "report.json").stat().st_mtime_ns == stamp
    assert main([*arguments, "--set", "window.max_keyframes=7"]) == 0
    assert (tmp_path / "out" / "other" / "report.json").stat().st_mtime_ns > stamp, "other parameters, other results"


@pytest.mark.slow
def test_recordings_and_results_may_be_urls(tmp_path: Path) -> None:
    pytest.importorskip("fsspec", reason="needs fsspec: pip install ba_node[fleet]")
    shutil.copy(MONO, tmp_path / "a.mcap")
    shutil.copy(MONO, tmp_path / "b.mcap")
    url = f"file://{tmp_path}"
    assert [name_of(place) for place in expand([f"{url}/*.mcap"])] == ["a", "b"]
    assert main(["replay", f"{url}/*.mcap", "--out", f"{url}/out", "--no-report"]) == 0
    assert (tmp_path / "out" / "a" / "trajectory.tum").read_bytes() == (
        tmp_path / "out" / "b" / "trajectory.tum"
    ).read_bytes()
    with pytest.raises(FleetError, match="nothing is there that matches"):
        expand([f"{url}/*.db3"])


def test_what_a_store_needs_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fsspec", reason="needs fsspec: pip install ba_node[fleet]")
    for missing, words in (("s3fs", "^s3://a/[*]: Install s3fs to access S3$"), ("fsspec", "pip install ba_node")):
        monkeypatch.setitem(sys.modules, missing, None)
        monkeypatch.setitem(sys.modules, f"{missing}.core", None)
        with pytest.raises(FleetError, match=words):
            expand(["s3://a/*"])


def test_all_bad_is_two(broken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("fsspec", reason="needs fsspec: pip install ba_node[fleet]")
    nothing = f"file://{tmp_path}/nothing.mcap"
    assert main(["replay", str(broken), nothing, "--out", str(tmp_path / "out"), "--no-report"]) == 2
    assert f"ba: error: {nothing}: FileNotFoundError" in capsys.readouterr().err


@pytest.mark.slow
def test_a_scheduler_that_is_not_there_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("distributed")
    arguments = ["replay", str(MONO), str(STEREO), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--scheduler", "tcp://127.0.0.1:1"]) == 2
    assert "ba: error: scheduler tcp://127.0.0.1:1: does not answer" in capsys.readouterr().err
    assert main([*arguments, "--jobs", "0"]) == 2
    assert not (tmp_path / "out").exists()


def test_many_are_checked(broken: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(MONO), str(broken)]) == 3
    shown = capsys.readouterr().out
    assert f"{MONO}: ok\n    the set-up fits the tracks" in shown
    assert f"{broken}: failed" in shown


def test_which_files_are_one_recording(tmp_path: Path) -> None:
    names = ["a_0.mcap", "a_1.mcap", "b.mcap"]
    places = [str(tmp_path / name) for name in names]
    assert batch.recordings(places) == [tuple(places[:2]), (places[2],)]
    assert batch.recordings(places, each=True) == [(place,) for place in places]
    assert not same_recording(tmp_path / "one" / "bag.mcap", tmp_path / "two" / "bag.mcap")
    assert batch.folder_names([("one/bag.mcap",), ("two/bag.mcap",)]) == ["bag", "bag_2"]
