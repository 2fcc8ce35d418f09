# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A map whose steps are all off the front-end's, by one factor or to one side, is given up; causes are named."""

from __future__ import annotations

import re

import numpy as np
import pytest

from ba_node.check.departure import departed, length_factor
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.scene.scene import Scene
from experiments.synthetic import SyntheticData
from tests.check.set_ups import recording, scene_of

STEP_NOISE_M = 0.02


def refined(
    data: SyntheticData,
    factor: float,
    keyframes: int = 30,
    seed: int = 0,
    noise_m: float = STEP_NOISE_M,
    aside_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scene:
    """Return a scene whose keyframes count as refined: poses as given, stretched by a factor and with noise.

    The camera is turned about axes of the body by ``aside_deg``, so that each body is turned back.
    """
    scene = scene_of(data, keyframes)
    table, rng = scene.keyframes, np.random.default_rng(seed)
    noise = np.cumsum(noise_m * rng.normal(size=(keyframes, 3)), axis=0)
    table.position[:] = factor * table.input_position + noise
    table.rotation[:] = geometry.so3_exp(np.array([0.1, 0.0, 0.4])) @ table.input_rotation
    table.position[:] = table.position @ geometry.so3_exp(np.array([0.1, 0.0, 0.4])).T
    table.rotation[:] = table.rotation @ geometry.so3_exp(-np.radians(aside_deg))
    table.refined[:] = True
    return scene


@pytest.mark.parametrize(
    ("mode", "factor", "words"),
    [
        ("stereo", 1.05, r"scale of focal length or baseline: lengths are 1\.0[45]\d? times .* 0\.9[456]\d? times"),
        ("stereo", 0.95, r"lengths are 0\.9[456]\d? times"),
        ("rgbd", 1.05, r"scale of depth_m: it is 1\.0[45]\d? times .* what depth_m tells"),
    ],
)
def test_one_factor_is_named(mode: str, factor: float, words: str) -> None:
    check = departed(refined(recording(mode=mode, path="line"), factor))
    assert check is not None and check.found is not None
    found = check.found
    assert found.harmful
    assert re.search(words, found.causes()), found.causes()


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["stereo", "rgbd"])
def test_noise_is_no_factor(mode: str) -> None:
    """A factor below that of good rigs and wheels, and the spread of the steps, say nothing."""
    data = recording(mode=mode, path="line")
    for seed in range(40):
        for factor in (0.99, 1.0, 1.01):
            assert departed(refined(data, factor, seed=seed)) is None, f"seed {seed}, factor {factor}"


@pytest.mark.parametrize("mode", ["stereo", "rgbd"])
def test_precise_odometry_tells_small_factors(mode: str) -> None:
    data = recording(4, mode=mode)
    for factor, noise_m, told in ((1.016, 0.001, True), (0.984, 0.001, True), (1.016, STEP_NOISE_M, False)):
        found = departed(refined(data, factor, noise_m=noise_m))
        assert (found is not None) == told, f"factor {factor}, noise {noise_m} m"
    assert departed(refined(data, 1.008, noise_m=0.001)) is None, "rigs and wheels are known no better"


@pytest.mark.parametrize("mode", ["mono", "stereo", "rgbd"])
@pytest.mark.parametrize("aside_deg", [(0.0, 0.0, 2.0), (0.0, -2.0, 0.0)])
def test_one_side_is_named(mode: str, aside_deg: tuple[float, float, float]) -> None:
    data = recording(mode=mode, path="line")
    check = departed(refined(data, 1.0, noise_m=0.005, aside_deg=aside_deg), final=True)
    assert check is not None and check.found is not None
    text = check.found.causes()
    found = re.search(r"principal point wrong, by about (\d+) px.*camera 0 does not fit .* by about 2 degrees", text)
    assert found, text
    expected = np.radians(2.0) * data.rig.intrinsics[0, 0]
    assert abs(int(found[1]) - expected) < 0.25 * expected, f"{text}: expected about {expected:.0f} px"


@pytest.mark.parametrize(("noise_m", "harmful"), [(0.0015, True), (0.012, False)])
def test_less_to_one_side_is_held_where_odometry_is_precise(noise_m: float, harmful: bool) -> None:
    scene = refined(recording(mode="stereo", path="line"), 1.0, noise_m=noise_m, aside_deg=(0.0, 0.0, 0.6))
    assert (departed(scene, final=True) is not None) == harmful
    assert departed(refined(recording(mode="stereo", path="line"), 1.0, noise_m=noise_m), final=True) is None


@pytest.mark.parametrize(("aside_deg", "told"), [((0.0, 0.0, 2.0), True), ((0.0, 2.0, 0.0), False)])
def test_a_camera_that_looks_aside_may_have_another_focal_length(
    aside_deg: tuple[float, float, float], told: bool
) -> None:
    """It turns the way in the plane of axis and way, and in no other; which of the three it is cannot be told."""
    data = recording(path="line", look_deg=-45.0)
    check = departed(refined(data, 1.0, noise_m=0.005, aside_deg=aside_deg), final=True)
    assert check is not None and check.found is not None
    text = check.found.causes()
    assert all(words in text for words in ("camera 0 does not fit", "principal point wrong")), text
    found = re.match(r"focal length off by a factor of about (\d\.\d\d)", text)
    assert bool(found) == told, text
    if found:
        # tan 45 deg over tan 43 or 47 deg
        assert abs(abs(np.log(float(found[1]))) - 0.07) < 0.015, text


def test_depths_of_a_camera_that_looks_aside_may_be_right_and_its_focal_length_wrong() -> None:
    for look_deg, told in ((0.0, False), (90.0, True)):
        check = departed(refined(recording(mode="rgbd", path="line", look_deg=look_deg), 1.05))
        assert check is not None and check.found is not None
        assert ("focal length off by a factor of about 0.9" in check.found.causes()) == told, check.found.causes()


def test_less_is_enough_at_the_end_alone() -> None:
    """A baseline that is 2 % off is told on most drives then, and on few before."""
    data = recording(path="line")
    before = at_the_end = 0
    for seed in range(20):
        scene = refined(data, 1.02, seed=seed)
        before += departed(scene) is not None
        check = departed(scene, final=True)
        if check is not None and check.found is not None:
            assert check.found.harmful and "baseline: lengths are 1.0" in check.found.causes()
            at_the_end += 1
        assert departed(refined(data, 1.0, seed=seed), final=True) is None, f"seed {seed}"
    assert before + 3 <= at_the_end, f"{before} of 20 before the end, {at_the_end} there"


def test_a_factor_that_is_hardly_chance_is_doubtful() -> None:
    data = recording(path="line")
    for noise_m, factor, doubted in ((0.005, 1.009, True), (0.005, 0.991, True), (STEP_NOISE_M, 1.004, False)):
        scene = refined(data, factor, noise_m=noise_m)
        assert departed(scene, final=True) is None
        expected = pytest.approx(factor, abs=0.003) if doubted else 1.0
        assert length_factor(scene) == expected, f"factor {factor}, noise {noise_m} m"


def test_steps_of_odometry_in_a_plane_are_compared_in_it() -> None:
    """A body that goes up and down moves by some percent more than its odometry in the plane has."""
    scene = refined(recording(path="line"), 1.0, noise_m=0.001)
    table = scene.keyframes
    table.input_position[:, 2] = 1.0
    table.input_rotation[:] = np.eye(3)
    table.position[:] = table.input_position
    table.rotation[:] = table.input_rotation
    table.position[scene.order, 2] += 0.15 * (np.arange(len(table)) % 2)
    assert length_factor(scene) == 1.0
    table.input_position[:, 2] += 1e-4 * np.random.default_rng(1).normal(size=len(table))
    assert length_factor(scene) > 1.004, "not in a plane"


def test_less_aside_is_doubted_at_the_end() -> None:
    """A camera that is turned by 1.3 degrees is not told for certain, but said; the map stays."""
    data, said = recording(path="line"), 0
    for seed in range(20):
        scene = refined(data, 1.0, seed=seed, aside_deg=(0.0, 0.0, 1.3))
        if departed(scene, final=True) is not None:
            continue
        check = departed(scene, final=True, doubted=True)
        if check is not None and check.found is not None:
            assert not check.found.harmful and "camera 0 does not fit" in check.found.causes()
            said += 1
        assert departed(refined(data, 1.0, seed=seed), final=True, doubted=True) is None, f"seed {seed}"
    assert said >= 3, f"{said} of 20 are doubted"


@pytest.mark.parametrize("mode", ["stereo", "rgbd"])
def test_where_much_moves_steps_that_were_carried_along_are_named(mode: str) -> None:
    data = recording(mode=mode, path="line")
    for sigmas, told in ((0.0, False), (1.0, False), (4.0, True)):
        scene = refined(data, 1.0, 50)
        # Twelve steps to the left.
        scene.keyframes.position[:, 1] += sigmas * STEP_NOISE_M * np.clip(np.arange(50) - 20, 0, 12)
        assert departed(scene, final=True) is None, "nothing is known to move"
        scene.log.warn("moving", "much moves")
        check = departed(scene, final=True)
        assert (check is not None) == told, f"{sigmas} sigmas"
        if check is not None and check.found is not None:
            words = check.found.causes()
            found = re.search(r"what moves carried the solution along from keyframe (\d+) to (\d+)", words)
            assert found and check.found.harmful, words
            ids = [int(scene.keyframes.keyframe_id[row]) for row in scene.order]
            assert abs(ids.index(int(found[1])) - 20) <= 2 and abs(ids.index(int(found[2])) - 32) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["mono", "stereo"])
def test_noise_is_no_side(mode: str) -> None:
    """A camera that is mounted to half a degree is as good as most; a roll along the way turns no step."""
    data = recording(mode=mode, path="line")
    for seed in range(40):
        for aside_deg in ((0.0, 0.5, 0.0), (0.0, 0.0, -0.5), (3.0, 0.0, 0.0)):
            assert departed(refined(data, 1.0, seed=seed, aside_deg=aside_deg), final=True) is None, (
                f"seed {seed}, {aside_deg}"
            )


@pytest.mark.parametrize("mode", ["mono", "stereo"])
def test_odometry_whose_errors_wander_is_no_fault(mode: str) -> None:
    """Steps err alike for some time, as by a bias that changes: few of them are independent."""
    data, said = recording(mode=mode, path="line"), 0
    for seed in range(20):
        scene, rng = refined(data, 1.0, noise_m=0.001), np.random.default_rng(seed)
        off = 0.02 * rng.normal(size=(30, 3))
        for k in range(1, 30):
            off[k] = 0.9 * off[k - 1] + np.sqrt(1.0 - 0.9**2) * off[k]
        scene.keyframes.position[scene.order] += np.cumsum(off, axis=0)
        said += departed(scene, final=True) is not None
    assert said <= 6, f"{said} of 20 are taken for a fault"


def test_where_it_cannot_be_asked() -> None:
    assert departed(refined(recording(mode="mono", path="line"), 1.1)) is None, "one camera has no scale"
    data = recording(path="line")
    assert departed(refined(data, 1.1, keyframes=10)) is None, "too few steps"
    assert departed(Scene(Config().scene)) is None
    half = refined(data, 1.1)
    half.keyframes.refined[::2] = False
    assert departed(half) is None, "no step has both ends refined"


def test_steps_that_are_noise_tell_nothing() -> None:
    """As those of a robot that turns on the spot: the front-end's are longer, whatever is right."""
    scene, rng = refined(recording(path="line"), 1.0), np.random.default_rng(5)
    scene.keyframes.position[:] = np.cumsum(1e-3 * rng.normal(size=(30, 3)), axis=0)
    scene.keyframes.input_position[:] = 1.2 * scene.keyframes.position + 5e-4 * rng.normal(size=(30, 3))
    assert departed(scene) is None


def test_a_way_that_is_standing_still_tells_nothing() -> None:
    scene = refined(recording(path="line"), 1.0)
    scene.keyframes.input_position[:] = scene.keyframes.position[:] = 0.0
    assert departed(scene) is None


def test_all_steps_together_tell_the_length_of_a_straight_way_of_one_camera() -> None:
    """Errors aside do not make it longer; a few steps that are far off do not tell."""
    data = recording(mode="mono", path="line")
    for aside in (0.0, 0.1):
        scene = refined(data, 1.01, noise_m=0.02)
        table = scene.keyframes
        turn = geometry.so3_exp(np.array([0.0, 0.0, aside]))
        table.input_position[:] = table.input_position @ turn.T
        assert length_factor(scene) == pytest.approx(1.01, abs=0.006), f"{aside} rad aside"
    table.input_position[scene.order[12:]] += 3.0 * (table.input_position[scene.order[1]] - table.input_position[0])
    assert length_factor(scene) == pytest.approx(1.01, abs=0.008)
    table.position[scene.order[20:]] = table.position[scene.order[20:0:-1]][: len(table) - 20]
    assert length_factor(scene) == 1.0, "it comes back"
