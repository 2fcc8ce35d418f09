# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read YAML as ROS does, or as OpenCV writes it, without aliases: a few make a text of 1 kB endless, or too large."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from ba_node.io.files import opened

MAX_BYTES = 2**20
# What OpenCV writes that is no YAML of version 1.1: its first line, and the tag of a matrix, a mapping of its own.
_OPENCV_HEAD, _OPENCV_TAG = re.compile(r"\A%YAML:1\.0[^\n]*\n"), re.compile(r"!!opencv-matrix")
# Of a value without quotes, which may be a number: to read one takes a time that grows with the square of its length.
_MAX_PLAIN = 1000


class YamlError(ValueError):
    """A text that is not YAML, or not of the kind that is read."""


class _Loader(yaml.SafeLoader):
    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Refuse aliases and endless numbers."""
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()  # type: ignore[no-untyped-call]
            where = f"line {event.start_mark.line + 1}"
            raise YamlError(f"{where}: alias *{event.anchor}: aliases are not read, as in ROS: write the value out")
        if self.check_event(yaml.ScalarEvent):
            event = self.peek_event()  # type: ignore[no-untyped-call]
            if event.style is None and len(event.value) > _MAX_PLAIN:
                raise YamlError(f"line {event.start_mark.line + 1}: a value of {len(event.value)} characters")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse a key that comes twice, of which the first would be lost."""
        seen: dict[str, int] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    text = f"{key.value!r} is in line {seen[key.value]} already: put them together"
                    raise YamlError(f"line {line}: {text}")
                seen[key.value] = line
        return super().construct_mapping(node, deep)


def read_yaml(path: Path | str, raised: type[ValueError]) -> Any:
    """Return the content of a file.

    Raises:
        ``raised``: it cannot be opened, is no regular file or larger than 1 MB, is not YAML, is nested too deep, or has
            aliases, a key twice or a number without end; names the file.
    """
    with opened(path, MAX_BYTES, raised) as stream:
        data = stream.read()
    try:
        text = _OPENCV_HEAD.sub("", data.decode("utf-8"))
        return yaml.load(text if len(text) == len(data) else _OPENCV_TAG.sub("", text), _Loader)
    except RecursionError:
        raise raised(f"{path}: nested too deep") from None
    except YamlError as error:
        raise raised(f"{path}: {error}") from error
    # Wrong dates and numbers are ValueErrors of Python.
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise raised(f"{path}: not YAML: {' '.join(str(error).split())}") from error
