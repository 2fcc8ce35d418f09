# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write config/*.yaml, docs/parameters.md, docs/topics.md and tables of docs/methods.md and front_end.md from the code.

docs/thesis.md and docs/open_problems.md are written from docs/thesis_results.json, which `ba thesis --all` makes,
and docs/thesis_second_run.json, verdicts.json of such a run with the kernels and the BLAS of another processor;
docs/robustness.md from docs/robustness_results.json, which is results.json of `ba robustness`.

Run it without arguments to write them, with --check to learn whether they are up to date (exit code 1 if not).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from ba_node.config import Config, Parameter, SolverOptions, Value, declarations, declared
from ba_node.config.front_end import FrontEndNodeOptions, FrontEndOptions
from ba_node.core.methods import METHODS
from ba_node.io.parameters import allowed, parameters_yaml, plain_yaml, scalar
from ba_node.messages.topics import ACTIONS, INTERFACE_VERSION, SERVICES, TOPICS, Command, Direction, Topic
from ba_node.scene.rejections import NOTICES, REASONS
from experiments.robustness.page import page as robustness_page
from experiments.thesis.open_page import open_page
from experiments.thesis.page import claims_page

# A page that is written by hand holds what is generated between these lines.
BEGIN, END = "<!-- begin: written by `{made_by}` -->\n", "<!-- end -->\n"

ROOT = Path(__file__).resolve().parent.parent
LICENCE = "# Copyright 2026 The ba_node Authors\n# SPDX-License-Identifier: Apache-2.0\n"
MADE_BY = "python tools/generate_docs.py"

TOPICS_INTRO = """\
# Topics

`ba_node` takes the messages of `ba_msgs` on relative names, so that a namespace or a remapping
(`-r keyframes:=front/keyframes`) connects it to a front-end. Outputs are below the node's own name. "Latched" is
reliable with durability transient local, "reliable" is reliable and volatile.

How a front-end talks to it:

1. Publish the cameras once, latched: `camera_rig`, or `camera_info` for one camera.
2. For every keyframe publish `keyframes`, and `feature_tracks` once for each camera. They are paired by `session_id`
   and `keyframe_id`, never by time, and may come in any order.
3. Give a point the same `track_id` in every image that sees it. Points that only one image sees are not used, unless
   they have a depth.
4. After a restart, or when tracking was lost for good, raise `session_id`: a new map begins.

What is known beside pixels comes on topics of its own, see [factors.md](factors.md).

These are the inputs of interface version {version}. They keep their fields, types and meanings from here on: what is
new comes as a new message on a topic of its own, and recordings of 0.2.0 replay by the definitions that they bring. The
outputs may gain fields at their end with another release of ba_msgs. Build front-end and node with the same ba_msgs:
each announces its definitions, and the node says which other node has another one, and whether another has its
name. A recording whose inputs lack a field is refused with its name.

A message that cannot be used is counted by reason in `report`, named in the node's log, and leaves everything known
as it was.
"""

PARAMETERS_INTRO = """\
# Parameters

The same names serve the node (`--ros-args -p window.max_keyframes:=30`, `--params-file`, `ros2 param set`) and
`ba replay` (`--set window.max_keyframes=30`, `--params my.yaml`). A change is checked as a whole: a name that does not
exist or a value out of range is refused with the reason, and nothing is changed. `ba params` prints a file with all
defaults, the same as `config/ba_node.yaml`.

"""


def topics_markdown() -> str:
    """Return docs/topics.md."""
    parts = [TOPICS_INTRO.format(version=INTERFACE_VERSION)]
    own = [topic for topic in TOPICS.values() if not topic.is_shared]
    parts += [
        _topics("Inputs", [topic for topic in own if topic.direction is Direction.TAKEN]),
        _topics("Outputs", [topic for topic in own if topic.direction is not Direction.TAKEN]),
        _topics("Topics that all of ROS shares", [topic for topic in TOPICS.values() if topic.is_shared]),
        _commands("Services", SERVICES),
        _commands("Action", ACTIONS),
    ]
    for title, folder in (("Messages", "msg"), ("Service types", "srv"), ("Action types", "action")):
        parts.append(f"## {title}\n")
        parts += [_interface(path) for path in sorted((ROOT / "msg_defs" / folder).glob(f"*.{folder}"))]
    parts.append(_table("Reasons for rejection", "In `report`, and in report.json of a replay.", REASONS))
    parts.append(_table("Notices", "Counted in report.json of a replay; nothing is lost by them.", NOTICES))
    return "\n".join(parts)


def parameters_page() -> str:
    """Return docs/parameters.md."""
    return PARAMETERS_INTRO + parameters_table(declarations())


def parameters_table(parameters: Sequence[Parameter]) -> str:
    """Return a table with a row for each parameter."""
    lines = ["| parameter | default | unit | allowed | change | meaning |", "|---|---|---|---|---|---|"]
    for p in parameters:
        change = "next solve" if p.live else "restart"
        lines.append(f"| `{p.name}` | {scalar(p.default)} | {p.unit} | {allowed(p)} | {change} | {p.doc} |")
    return "\n".join(lines) + "\n"


def renewed(name: str, tables: str) -> str:
    """Return a page of docs/ with its tables renewed."""
    text = (ROOT / "docs" / name).read_text(encoding="utf-8")
    begin = BEGIN.format(made_by=MADE_BY)
    before, found, rest = text.partition(begin)
    _, closed, after = rest.partition(END)
    if not (found and closed):
        raise SystemExit(f"docs/{name}: expected the lines {begin.strip()} and {END.strip()}")
    return before + begin + "\n" + tables + "\n" + END + after


def of_the_front_end(*groups: type) -> list[Parameter]:
    """Return options of ba_front_end, which are all set at start."""
    return [dataclasses.replace(parameter, live=False) for group in groups for parameter in declared(group)]


def methods_tables() -> str:
    """Return the named methods, what they choose, and what each part may be."""
    options = {option.name: option for option in declared(SolverOptions)}
    about = ["| method | what | source |", "|---|---|---|"]
    about += [f"| `{method.name}` | {method.doc} | {method.source} |" for method in options["method"].allowed]
    names = list(METHODS)
    chosen = ["| option | " + " | ".join(f"`{name}`" for name in names) + " |", "|---" * (len(names) + 1) + "|"]
    described = [dataclasses.asdict(METHODS[name]) for name in names]
    chosen += [
        f"| {option} | " + " | ".join(_shown(option, values) for values in described) + " |"
        for option in described[0]
        if option not in ("method", "kernels", "cheirality", "objective_tolerance")
    ]
    parts = ["| option | choice | what | source |", "|---|---|---|---|"]
    for part in options.values():
        if part.name == "method" or not part.allowed:
            continue
        aliases = f" (also `{'`, `'.join(part.aliases)}`)" if part.aliases else ""
        parts.append(f"| **`{part.name}`**{aliases} | | {part.doc} | |")
        for choice in part.allowed:
            also = f" (`{'`, `'.join(choice.aliases)}`)" if choice.aliases else ""
            parts.append(f"| | `{choice.name}`{also} | {choice.doc} | {choice.source} |")
    return "\n".join([*about, "", *chosen, "", *parts]) + "\n"


def _shown(option: str, values: dict[str, Value]) -> str:
    """Return a value for the table, a dash where it has no meaning beside the other choices."""
    idle = {
        "initial_damping": values["damping"] == "none",
        "damping_policy": values["damping"] == "none",
        "initial_radius": values["trust_region"] == "none",
        "loss_scale_px": values["loss"] == "squared",
        **dict.fromkeys(
            ("preconditioner", "t_eps", "max_linear_iterations"), values["linear_solver"] not in ("auto", "pcg")
        ),
    }
    value = values[option]
    return "–" if idle.get(option) else f"{value:g}" if isinstance(value, float) else str(value)


def yaml_file() -> str:
    """Return config/ba_node.yaml."""
    return f"{LICENCE}# All parameters with their defaults; written by `{MADE_BY}`.\n{parameters_yaml(Config())}"


def front_end_yaml() -> str:
    """Return config/ba_front_end.yaml: how images are tracked; which ones are is said to the launch file."""
    note = f"# How ba_front_end tracks, with the defaults; written by `{MADE_BY}`.\n"
    return LICENCE + note + plain_yaml(of_the_front_end(FrontEndOptions))


def pages() -> dict[str, str]:
    """Return the content of every generated file by its path from the root."""
    results = json.loads((ROOT / "docs" / "thesis_results.json").read_text(encoding="utf-8"))
    second = json.loads((ROOT / "docs" / "thesis_second_run.json").read_text(encoding="utf-8"))
    robustness = json.loads((ROOT / "docs" / "robustness_results.json").read_text(encoding="utf-8"))
    note = f"<!-- Written by `{MADE_BY}`: do not edit. -->\n\n"
    front_end_table = parameters_table(of_the_front_end(FrontEndNodeOptions, FrontEndOptions))
    return {
        "config/ba_node.yaml": yaml_file(),
        "docs/parameters.md": note + parameters_page(),
        "docs/methods.md": renewed("methods.md", methods_tables()),
        "docs/front_end.md": renewed("front_end.md", front_end_table),
        "config/ba_front_end.yaml": front_end_yaml(),
        "docs/thesis.md": note + claims_page(results, second),
        "docs/open_problems.md": note + open_page(results),
        "docs/robustness.md": note + robustness_page(robustness),
        "docs/topics.md": note + topics_markdown(),
    }


# What stands between the lines `---` of a definition.
_SECTIONS = {".msg": ("",), ".srv": ("Request", "Response"), ".action": ("Goal", "Result", "Feedback")}


def _interface(path: Path) -> str:
    """Return a table of the fields of a message, or one for each part of a service or an action."""
    text = path.read_text(encoding="utf-8")
    first, *_ = text.splitlines()
    about = first.removeprefix("# ")
    head = f"### ba_msgs/{path.stem}\n\n{about}\n"
    sections = text.removeprefix(first).split("\n---\n")
    return "\n".join([head, *(_fields(*part) for part in zip(_SECTIONS[path.suffix], sections, strict=True))])


def _fields(title: str, section: str) -> str:
    """Return a table of the fields in one part of a definition."""
    head = f"{title}:\n\n" if title else ""
    lines = (line.partition("#") for line in section.splitlines() if line.strip())
    fields = [(*code.strip().split(" ", 1), comment.strip()) for code, _, comment in lines]
    rows = "".join(f"| `{name.strip()}` | `{kind}` | {comment} |\n" for kind, name, comment in fields)
    return f"{head}| field | type | meaning |\n|---|---|---|\n{rows}"


def _topics(title: str, topics: list[Topic]) -> str:
    """Return a table of topics; with a column of directions where these differ."""
    directions = len({topic.direction is Direction.TAKEN for topic in topics}) > 1
    heads = ["topic", "type", *(["direction"] if directions else []), "quality of service", "what"]
    lines = [f"## {title}\n", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for topic in topics:
        cells = [f"`{topic.given_name}`", f"`{topic.type_name}`", topic.delivery.value, topic.text]
        lines.append(f"| {' | '.join(cells[:2] + [topic.direction.value] * directions + cells[2:])} |")
    return "\n".join(lines) + "\n"


def _commands(title: str, commands: dict[str, Command]) -> str:
    """Return a table of services or actions."""
    rows = "\n".join(f"| `~/{name}` | `{command.type_name}` | {command.text} |" for name, command in commands.items())
    return f"## {title}\n\n| name | type | what |\n|---|---|---|\n{rows}\n"


def _table(title: str, about: str, entries: dict[str, str]) -> str:
    rows = "\n".join(f"| `{name}` | {doc} |" for name, doc in entries.items())
    return f"## {title}\n\n{about}\n\n| reason | what |\n|---|---|\n{rows}\n"


def main(argv: Sequence[str] | None = None) -> int:
    """Write or check the files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a file is stale")
    args = parser.parse_args(argv)
    stale = []
    for name, text in pages().items():
        path = ROOT / name
        if path.is_file() and path.read_text(encoding="utf-8") == text:
            continue
        stale.append(name)
        if not args.check:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    if stale:
        print(f"{'stale' if args.check else 'written'}: {', '.join(stale)}")
    return 1 if args.check and stale else 0


if __name__ == "__main__":
    sys.exit(main())
