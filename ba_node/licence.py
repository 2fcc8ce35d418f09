# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The licence of the source files, for ament_copyright: it asks for entry points, and knows whole headers only."""

from typing import NamedTuple


class Licence(NamedTuple):
    """What ament_copyright looks for, in files by their kind; each kind may have several texts."""

    name: str
    spdx: str
    file_headers: tuple[str, ...]
    license_files: tuple[str, ...] = ()
    contributing_files: tuple[str, ...] = ()


APACHE2_SPDX = Licence(
    "Apache License, Version 2.0", "Apache-2.0", ("{copyright}\nSPDX-License-Identifier: Apache-2.0",)
)
