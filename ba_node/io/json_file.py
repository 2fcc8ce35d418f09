# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write JSON that every reader takes: null for infinity and NaN, which JSON does not have."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ba_node.io.files import whole_file


def write_json(path: Path | str, content: Mapping[str, Any]) -> None:
    """Write a file that is either whole or not there."""
    text = json.dumps(_plain(content), indent=2, allow_nan=False, ensure_ascii=False)
    with whole_file(path) as stream:
        stream.write(f"{text}\n".encode())


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
