# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""From experiments to pages: what was run stays, what was interrupted goes on, what has changed is run again."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest

from ba_node.core.solver import solve
from experiments.thesis import runner
from experiments.thesis.data_sets import DataError
from experiments.thesis.experiments import Case, Experiment
from experiments.thesis.problems import Library
from experiments.thesis.repeat import Repetition, results
from experiments.thesis.tasks import Measure, Run, Task, key


def repetition(experiment: Experiment, out: Path) -> Repetition:
    return Repetition([experiment], Path("no-such-folder"), out)


def clock() -> float:
    return 0.0


def labels(experiment: Experiment, tasks: list[Task]) -> set[str]:
    return {case.label for case in experiment.cases if case.task in tasks}


def test_records_hold_the_trace_and_how_it_ended(tiny: Experiment, tmp_path: Path) -> None:
    (section,) = repetition(tiny, tmp_path).run(clock)
    record = section.records["DINM"]
    trace = record["trace"]
    taken = [row for row in trace[1:] if row["accepted"]]
    assert len(taken) == 4 and record["reason"] == "took 4 steps"
    assert all(b["objective"] <= a["objective"] for a, b in itertools.pairwise(trace))
    assert {"time_s", "gradient_norm", "linear_iterations", "damping", "radius", "side"} <= trace[0].keys()
    norms = record["gradient"]["norms"]
    whole = float(np.sqrt(sum(norm**2 for norm in norms.values())))
    assert whole == pytest.approx(trace[-1]["gradient_norm"], rel=1e-9), "the kinds make up the whole"
    assert record["truth_after"]["rmse_points"] < record["truth_before"]["rmse_points"]
    assert [image["image"] for image in record["images"]] == [0, 3]
    assert record["problem"] == {"name": "10-253", "images": 10, "points": 253, "observations": 1334}
    assert abs(section.metrics["Taylor"]["slope"] - 2.0) < 0.1


def test_what_was_interrupted_goes_on_where_it_stopped(
    tiny: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[str] = []

    def interrupted(problem, options, **others):  # type: ignore[no-untyped-def]
        ran.append(options.method)
        if len(ran) == 2:
            raise KeyboardInterrupt
        return solve(problem, options, **others)

    monkeypatch.setattr(runner, "solve", interrupted)
    with pytest.raises(KeyboardInterrupt):
        repetition(tiny, tmp_path).run(clock)
    done = {path.name for path in (tmp_path / "runs").iterdir()}
    assert len(done) == 1 and not [name for name in done if name.endswith(".partial")]
    left = repetition(tiny, tmp_path).missing()
    assert len(left) == 3
    monkeypatch.setattr(runner, "solve", solve)
    before = {name: (tmp_path / "runs" / name).stat().st_mtime_ns for name in done}
    (section,) = repetition(tiny, tmp_path).run(clock)
    assert set(section.records) == {case.label for case in tiny.cases}
    assert {name: (tmp_path / "runs" / name).stat().st_mtime_ns for name in done} == before
    assert repetition(tiny, tmp_path).missing() == []


@pytest.mark.slow
def test_a_second_run_solves_nothing_and_says_the_same(
    tiny: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = repetition(tiny, tmp_path)
    sections = first.run(clock)
    page = first.write(sections).read_bytes()

    def never(*_: object, **__: object) -> None:
        raise AssertionError("solved again")

    monkeypatch.setattr(runner, "solve", never)
    second = repetition(tiny, tmp_path)
    again = second.run(clock)
    assert results(again) == results(sections)
    assert second.write(again).read_bytes() == page


def test_an_option_that_changed_and_a_damaged_record_are_run_again(tiny: Experiment, tmp_path: Path) -> None:
    repetition(tiny, tmp_path).run(clock)
    case = tiny.cases[0]
    assert isinstance(case.task, Run)
    task = dataclasses.replace(case.task, settings=("cap=7",))
    changed = dataclasses.replace(tiny, cases=(dataclasses.replace(case, task=task), *tiny.cases[1:]))
    assert repetition(changed, tmp_path).missing() == [task]
    damaged = tmp_path / "runs" / f"{key(case.task, Library(tmp_path))}.json"
    damaged.write_text(damaged.read_text()[:-50])
    assert labels(tiny, repetition(tiny, tmp_path).missing()) == {"DINM"}


def test_every_seed_is_a_run_of_its_own_from_a_start_moved_by_rounding(tiny: Experiment, tmp_path: Path) -> None:
    case = dataclasses.replace(tiny.cases[1], seeds=3)
    assert isinstance(case.task, Run)
    assert case.tasks()[0] == case.task
    assert len({key(task, Library(tmp_path)) for task in case.tasks()}) == 3
    assert tiny.cases[2].tasks() == (tiny.cases[2].task,), "what is measured beside the loop has no start to move"
    problem = Library(tmp_path).get("10-253").problem
    starts = [runner.moved(problem, seed).start.points for seed in (0, 1, 2)]
    assert (starts[0] == problem.start.points).all()
    for one, other in itertools.combinations(starts, 2):
        assert 0.0 < np.max(np.abs(one - other)) < 1e-11 * np.max(np.abs(one))
    only = dataclasses.replace(tiny, cases=(tiny.cases[0], case), plots=())
    (section,) = repetition(only, tmp_path).run(clock)
    found = section.metrics["LMA-CD"]
    low, high = found["spread"]["gradient"]
    assert low < found["gradient"] < high
    assert results([section])["9.9"]["LMA-CD"]["seeds"] == 3


def test_in_the_time_of_another_is_looked_at_in_time(tiny: Experiment, tmp_path: Path) -> None:
    ticks = itertools.count()
    timed = dataclasses.replace(tiny, cases=tiny.cases[:2], plots=(), clock="LMA-CD")
    (section,) = repetition(timed, tmp_path).run(lambda: float(next(ticks)))
    trace = section.records["DINM"]["trace"]
    end = section.records["LMA-CD"]["trace"][-1]["time_s"]
    expected = [row for row in trace if row["time_s"] <= end][-1]
    assert expected is not trace[-1]
    assert section.metrics["DINM"]["gradient_in_time"] == expected["gradient_norm"]


def test_keys_do_not_depend_on_the_machine() -> None:
    # Written down here: it changes only if the options of the method or of the sphere do, and then it must.
    task = Measure("10-253", "taylor")
    assert key(task, Library(Path("a"))) == key(task, Library(Path("b")))
    assert key(task, Library(Path())) != key(Measure("10-289", "taylor"), Library(Path()))


@pytest.mark.slow
def test_the_page_holds_everything(tiny: Experiment, tmp_path: Path) -> None:
    made = repetition(tiny, tmp_path)
    page = made.write(made.run(clock)).read_text()
    assert page.count("data:image/png;base64,") == len(tiny.plots)
    assert not re.findall(r"""(?:src|href)=['"](?!data:|#)""", page), "the page needs other files"
    assert "With a &amp; in its note." in page
    text = (tmp_path / "report.md").read_text()
    for name in re.findall(r"\]\((images/[^)]+)\)", text):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert (
        table[0] == "|  | time [s] (ratio) | thesis | objective at the end | thesis | steps taken | slope | thesis |"
        " why it stopped |"
    )
    lma = next(line for line in table if line.startswith("| LMA-CD"))
    assert "| 5 (0.5) |" in lma, "the thesis's time has its ratio to the first row"
    metrics = json.loads((tmp_path / "results.json").read_text())["9.9"]
    assert metrics["DINM"]["steps"] == 4.0
    assert not any("the problem" in line for line in table), "a case without figures makes no row"


def test_progress_ends_at_one_for_each_task(tiny: Experiment, tmp_path: Path) -> None:
    told: list[tuple[Task, float]] = []
    repetition(tiny, tmp_path).run(clock, lambda task, share: told.append((task, share)))
    ends = [task for task, share in told if share >= 1.0]
    assert set(ends) == {task for case in tiny.cases for task in case.tasks()}
    assert all(0.0 <= share <= 1.0 for _, share in told)


def test_quick_takes_few_steps_and_leaves_out_what_is_large(tiny: Experiment, tmp_path: Path) -> None:
    large = Case("large", Run("500-5000", "dinm"), seeds=1)
    wide = dataclasses.replace(tiny, cases=(*tiny.cases, large))
    quick = Repetition([wide], tmp_path, tmp_path, quick=True).missing()
    assert len(quick) == 4
    assert max(task.weight for task in quick if isinstance(task, Run)) == 3


def test_a_missing_data_set_is_named_with_where_to_get_it(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"problem-49-7776-pre\.txt\.bz2 from the Ladybug data sets of https://grail"):
        Library(tmp_path).get("ladybug-49")
    with pytest.raises(DataError, match=r"choose one of ladybug-49, ladybug-10, .*, kitti, 10-253"):
        Library(tmp_path).identity("ladybug-50")
