# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Pages of replays, opened by a real browser from a file."""

from __future__ import annotations

import base64
import gzip
import importlib.util
import json
import re
import shutil
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from numpy.typing import NDArray

from ba_node.cli.main import main
from ba_node.config import Config
from ba_node.estimate import Cloud, Poses
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_writer import BagWriter
from ba_node.io.ply import write_ply
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.io.trajectory import write_tum
from ba_node.messages.factory import header_message
from ba_node.offline.figures import figures
from ba_node.offline.replay import Watch, replay
from ba_node.offline.report import REPORT, show, write_report
from ba_node.offline.run_folder import BINS, DETAILS, PARALLAX_DEG, SOLVES, read_run
from tests.browser import BROWSERS, BrowserError, browse

BAG = Path(__file__).resolve().parents[2] / "bags" / "mono_loop.mcap"
KEYS = [
    *("above", "space", "error", "objective", "residuals", "histogram"),
    *("tracks", "health", "held_out", "latency", "rejected"),
]
LIMIT_BYTES = 5_000_000
needs_browser = pytest.mark.skipif(not any(map(shutil.which, BROWSERS)), reason=f"needs one of {', '.join(BROWSERS)}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report") / "mono"
    times = iter(np.arange(10_000) * 0.002)
    replay(BAG, out, Config(), Watch(clock=lambda: float(next(times))))
    write_report([out], out / REPORT)
    return out


def drawn(dom: str) -> dict[str, int]:
    """Return how many drawings (SVG or canvas) each figure of a page has."""
    parts = re.split(r'id="plot-(\w+)"', dom)
    return {
        key: len(re.findall(r'class="main-svg"|<canvas', body))
        for key, body in zip(parts[1::2], parts[2::2], strict=True)
    }


def unpacked(page: Path, part: str) -> str:
    found = re.search(f'id="{part}">([^<]+)<', page.read_text())
    assert found is not None
    return gzip.decompress(base64.b64decode(found[1])).decode()


@pytest.mark.slow
def test_the_page_has_all_figures_and_facts(folder: Path) -> None:
    pytest.importorskip("plotly", reason="needs plotly: pip install ba_node[report]")
    text = (folder / REPORT).read_text()
    data = json.loads(unpacked(folder / REPORT, "data"))
    assert [figure["key"] for figure in data] == KEYS
    assert "plotly.js v" in unpacked(folder / REPORT, "library")[:200]
    assert "http" not in re.sub(r'<script type="application.*?</script>', "", text, flags=re.DOTALL)
    assert "40 of 40 keyframes refined" in text
    report = json.loads((folder / "report.json").read_text())
    assert report["recording"]["files"][0]["sha256"] in text
    assert report["versions"]["numpy"] in text
    assert "All parameters have their defaults" in text


@pytest.mark.slow
def test_figures_show_what_is_in_the_files(folder: Path) -> None:
    run = read_run(folder)
    shown = {figure.key: figure for figure in figures([run])}
    error = shown["error"].data
    assert [trace["name"] for trace in error] == ["before", "after"]
    assert np.sqrt(np.mean(error[1]["y"] ** 2)) == pytest.approx(run.report["trajectory_error_m"]["refined"], rel=1e-5)
    times = run.report["solve_times_s"]
    assert len(times) == run.report["solves"] == 40
    seen = run.details["views"] @ np.arange(len(run.details["views"]))
    assert 0.9 * seen < 0.5 * run.details["histogram"].sum() < seen <= run.report["observations"]


@needs_browser
@pytest.mark.slow
def test_a_browser_draws_every_figure_and_reports_no_error(folder: Path) -> None:
    pytest.importorskip("plotly", reason="needs plotly: pip install ba_node[report]")
    dom = browse(folder / REPORT)
    assert f'data-drawn="{len(KEYS)}"' in dom
    counts = drawn(dom)
    assert list(counts) == KEYS
    assert all(counts.values()), counts


@pytest.mark.slow
def test_each_figure_is_a_picture_too(folder: Path) -> None:
    pictures = sorted((folder / "report").iterdir())
    assert [picture.stem for picture in pictures] == sorted(KEYS)
    for picture in pictures:
        image = matplotlib.image.imread(picture)
        assert image.shape[1] >= 700
        assert (image[..., :3] < 0.9).any(axis=2).mean() > 0.003, picture.name


@needs_browser
@pytest.mark.slow
def test_an_error_in_the_page_is_found(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("plotly", reason="needs plotly: pip install ba_node[report]")
    page = tmp_path / "page.html"
    page.write_text((folder / REPORT).read_text().replace('id="data">', 'id="data">!'))
    with pytest.raises(BrowserError, match="the browser reports: "):
        browse(page)


@needs_browser
@pytest.mark.slow
def test_a_long_recording_fits_into_five_megabytes(tmp_path: Path) -> None:
    pytest.importorskip("plotly", reason="needs plotly: pip install ba_node[report]")
    large(tmp_path, keyframes=1000, points=100_000)
    write_report([tmp_path], tmp_path / REPORT)
    assert (tmp_path / REPORT).stat().st_size < LIMIT_BYTES
    counts = drawn(browse(tmp_path / REPORT))
    assert list(counts) == KEYS
    assert all(counts.values()), counts


def large(folder: Path, keyframes: int, points: int) -> None:
    """Write results of a replay as long as is asked for, of random numbers, which pack worst."""
    rng = np.random.default_rng(3)
    stamps = 100_000_000 * np.arange(keyframes, dtype=np.int64)
    position = np.cumsum(rng.normal(size=(keyframes, 3)), axis=0)
    poses = Poses(
        np.arange(keyframes, dtype=np.uint64), stamps, position, np.tile([0.0, 0.0, 0.0, 1.0], (keyframes, 1))
    )
    for name in ("trajectory", "trajectory_input", "ground_truth"):
        write_tum(folder / f"{name}.tum", poses)
    cloud = Cloud(
        np.arange(points, dtype=np.uint64), rng.normal(0.0, 30.0, (points, 3)), np.ones(points, np.float32),
        np.full(points, 5, np.int32),
    )  # fmt: skip
    write_ply(folder / "points.ply", cloud, "map")
    details: dict[str, NDArray[Any]] = {name: rng.uniform(0.1, 1.0, keyframes) for name in SOLVES}
    details |= {"reason": np.full(keyframes, ""), "status": np.full(keyframes, "CONVERGED"), "solve_stamp_ns": stamps}
    n = 20_000
    details |= {"error": rng.normal(size=(n, 2)).astype("f4"), "uv": rng.uniform(0, 700, (n, 2)).astype("f4")}
    details |= {"camera": rng.integers(0, 2, n), "keyframe": np.zeros(n, int), "outlier": rng.random(n) < 0.03}
    details |= {"histogram": np.ones(len(BINS) - 1), "views": np.arange(30), "parallax": np.ones(len(PARALLAX_DEG) - 1)}
    np.savez_compressed(folder / DETAILS, **details)  # type: ignore[arg-type]
    (folder / "effective.yaml").write_text("{}\n")
    one = {"input": 1.0, "refined": 0.5}
    report = {
        "bag": "long", "session_id": 1, "topics_taken": {"keyframes": "/keyframes"}, "versions": {"ba_node": "0"},
        "attention": ["one thing <to> look at"], "keyframes_refined": keyframes, "keyframes": keyframes,
        "trajectory_error_m": one, "median_px": one, "rms_px": one, "rms_px_without_outliers": one,
        "landmarks": points, "observations": n, "outliers": 7, "solves": keyframes, "solves_by_status": {},
        "solver_time_s": 1.0, "solve_times_s": rng.uniform(0.0, 0.1, keyframes).tolist(), "bag_rejected": {},
        "rejected": {"non_finite": 3}, "recording": {"files": [{"name": "a", "bytes": 7, "sha256": "00"}]},
    }  # fmt: skip
    (folder / "report.json").write_text(json.dumps(report))


@pytest.mark.slow
def test_several_runs_stand_side_by_side(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("plotly", reason="needs plotly: pip install ba_node[report]")
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    path = tmp_path / "compare.html"
    assert main(["report", str(folder), str(other), "--out", str(path)]) == 0
    text = path.read_text()
    assert "2 replays side by side" in text
    assert "<th>mono</th><th>other</th>" in text
    names = {trace["name"] for figure in json.loads(unpacked(path, "data")) for trace in figure["data"]}
    assert {"mono: after", "other: after"} <= names


@pytest.mark.slow
def test_a_replay_leaves_a_page_and_a_picture_unless_told_not_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("plotly", reason="needs plotly: pip install ba_node[report]")
    assert main(["replay", str(BAG), "--out", str(tmp_path / "with")]) == 0
    assert "trajectory.png, report.html, each figure as PNG in report/" in capsys.readouterr().out
    assert (tmp_path / "with" / REPORT).stat().st_size > 1_000_000
    assert matplotlib.image.imread(tmp_path / "with" / "trajectory.png").shape[1] > 800
    assert main(["replay", str(BAG), "--out", str(tmp_path / "without"), "--no-report"]) == 0
    assert not {REPORT, "report", "trajectory.png"} & {path.name for path in (tmp_path / "without").iterdir()}


@pytest.mark.slow
def test_without_plotly_the_picture_is_there_and_the_line_says_what_to_install(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    assert "pip install ba_node[report]" in write_report([folder], folder / "none.html")
    assert not (folder / "none.html").exists()
    assert len(list((folder / "none").iterdir())) == len(KEYS)
    assert show(folder).startswith("trajectory.png, each figure as PNG in report/; ")


def test_a_folder_without_results_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path)]) == 2
    assert f"{tmp_path}: no results of ba replay, there is no report.json in it" in capsys.readouterr().err


@pytest.mark.slow
def test_residuals_are_drawn_on_the_image_where_there_is_one(folder: Path, tmp_path: Path) -> None:
    """A copy of the recording with an image for one keyframe: that which sees the most."""
    run = read_run(folder)
    stamp = int(run.after.stamp_ns[int(run.details["shown_keyframe"])])
    path = tmp_path / "with_images.mcap"
    with BagReader(BAG) as reader, BagWriter(path) as writer:
        for topic, kind, time_ns, data in reader.messages():
            writer.write(topic, kind, reader.decode(topic, data), time_ns)
        for image_ns, level in ((stamp - 1, 10), (stamp, 200)):
            header = header_message(ROSBAGS_FACTORY, image_ns, "camera")
            pixels = np.full(480 * 752, level, np.uint8)
            fields = {"height": 480, "width": 752, "encoding": "mono8", "is_bigendian": 0, "step": 752, "data": pixels}
            image = ROSBAGS_FACTORY.make("sensor_msgs/msg/Image", header=header, **fields)
            writer.write("/camera/image_raw", "sensor_msgs/msg/Image", image, image_ns)
    out = tmp_path / "out"
    replay(path, out, Config())
    found = read_run(out)
    assert found.details["image_0"].shape == (480, 752)
    assert (found.details["image_0"] == 200).all()
    arrows = next(figure for figure in figures([found]) if figure.key == "residuals")
    assert "in the keyframe that sees the most" in arrows.caption
    (picture,) = arrows.layout["images"]
    assert (picture["sizex"], picture["sizey"]) == (752, 480)
    assert picture["source"].startswith("data:image/jpeg;base64,/9j/")
    own = (found.details["keyframe"] == found.details["shown_keyframe"]) & ~found.details["outlier"]
    assert len(arrows.data[0]["x"]) == 3 * np.count_nonzero(own) > 0


def test_residuals_next_to_nothing_fit_into_a_tile(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "run")
    report = json.loads((folder / "report.json").read_text())
    report["median_px"] = {"input": 1.11e-5, "refined": 1.11e-5}
    (tmp_path / "run" / "report.json").write_text(json.dumps(report))
    write_report([tmp_path / "run"], tmp_path / REPORT)
    page = (tmp_path / REPORT).read_text()
    assert "<b>&lt;0.001 → &lt;0.001 px</b><span>median residual" in page
    assert "e-05 →" not in page and ".tile b { display: block; font-size: 18px; font-weight" in page
