# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read YAML as ROS does, without aliases: a few of them make a text of 1 kB as large as any memory, or endless."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

MAX_BYTES = 2**20


class YamlError(ValueError):
    """A text that is not YAML, or not of the kind that is read."""


class _Loader(yaml.SafeLoader):
    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Refuse aliases."""
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()  # type: ignore[no-untyped-call]
            where = f"line {event.start_mark.line + 1}"
            raise YamlError(f"{where}: alias *{event.anchor}: aliases are not read, as in ROS: write the value out")
        return super().compose_node(parent, index)


def read_yaml(path: Path | str) -> Any:
    """Return the content of a file.

    Raises:
        YamlError: it is not YAML, larger than 1 MB, nested too deep, or has aliases.
        OSError: it cannot be read.
    """
    with Path(path).open("rb") as stream:
        data = stream.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise YamlError(f"more than {MAX_BYTES >> 20} MB: expected a file of parameters or of metadata")
    try:
        return yaml.load(data.decode("utf-8"), _Loader)
    except RecursionError:
        raise YamlError("nested too deep") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        if isinstance(error, YamlError):
            raise
        # Wrong dates and numbers are ValueErrors of Python.
        raise YamlError(f"not YAML: {' '.join(str(error).split())}") from error
