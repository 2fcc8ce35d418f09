# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What .venv needs of the machine, and what to do where it is missing or a step fails: each in one line."""

from __future__ import annotations  # so that an older Python comes as far as check_python

import importlib.util
import re
import shlex
import shutil
import sys
import sysconfig
from collections.abc import Iterable, Mapping
from pathlib import Path

SUPPORTED = ((3, 10), (3, 13))

# What pip prints without a connection; a package without any version is an index that pip does not see.
UNREACHABLE = (
    r"from versions: none|ConnectionError|ConnectTimeout|ReadTimeout|name resolution|ProxyError|SSLError|IncompleteRead"
)


class SetupError(Exception):
    """The environment cannot be made; the text is one line that says what to do."""


def check_python(version: tuple[int, int]) -> None:
    """Raise SetupError unless the ROS wheels exist for this version of Python."""
    lowest, highest = SUPPORTED
    if not lowest <= version <= highest:
        raise SetupError(
            f"Python {dotted(version)} is not supported: the ROS 2 Jazzy wheels exist for {dotted(lowest)} to "
            f"{dotted(highest)}; choose one, for example: make PYTHON=python3.12 setup"
        )


def check_platform(system: str, machine: str) -> None:
    """Raise SetupError unless the ROS wheels exist for this kind of machine."""
    if (system, machine) != ("Linux", "x86_64"):
        raise SetupError(
            f"the ROS 2 Jazzy wheels exist for Linux x86_64 only, this is {system} {machine}: "
            "install ROS 2 Jazzy, source its setup.bash and run `colcon build`"
        )


def check_tools(environ: Mapping[str, str]) -> None:
    """Raise SetupError if the venv module, the headers of Python or a compiler is missing."""
    version = dotted(sys.version_info[:2])
    if importlib.util.find_spec("venv") is None or importlib.util.find_spec("ensurepip") is None:
        raise SetupError(
            f"Python {version} has no venv module: install it (sudo apt install python{version}-venv), "
            "then run make again"
        )
    if include_dir() is None:
        raise SetupError(
            f"Python.h of Python {version} is missing: install it (sudo apt install python{version}-dev), "
            "then run make again"
        )
    check_compiler("CC", "C", ("cc", "gcc", "clang"), environ)
    check_compiler("CXX", "C++", ("c++", "g++", "clang++"), environ)


def check_compiler(variable: str, language: str, names: Iterable[str], environ: Mapping[str, str]) -> None:
    """Raise SetupError unless the compiler named by a variable, or else one of the usual names, is on the path."""
    chosen = shlex.split(environ.get(variable, ""))[:1]
    if any(shutil.which(name, path=environ.get("PATH")) for name in chosen or names):
        return
    if chosen:
        raise SetupError(f"{variable}={chosen[0]} is not a program: correct it or unset it, then run make again")
    raise SetupError(
        f"no {language} compiler (looked for {', '.join(names)}): install one (sudo apt install build-essential) "
        f"or name it in {variable}, then run make again"
    )


def include_dir() -> str | None:
    """Return the folder with the Python.h of the running Python, or None."""
    folders = (sysconfig.get_path("include"), sysconfig.get_config_var("INCLUDEPY"))
    return next((folder for folder in folders if folder and Path(folder, "Python.h").is_file()), None)


def dotted(version: tuple[int, int]) -> str:
    """Write (3, 11) as 3.11."""
    return f"{version[0]}.{version[1]}"


def pip_failure(output: str) -> str:
    """Say in a few words why pip failed, from what it printed."""
    package = re.search(
        r"(?:requirement|distribution found for|Failed to build(?: wheel for)?) '?([\w.\[\]-]+(?:==[\w.]+)?)", output
    )
    what = f"cannot install {package[1]}" if package else "cannot install the packages"
    if "No space left on device" in output:
        return f"{what}: the disk is full; free about 1.5 GB, then run make again"
    if re.search(UNREACHABLE, output):
        return f"{what}: the package index cannot be reached; check the network and proxy, then run make again"
    if "No matching distribution" in output:
        return f"{what}: the package index has no such version for this Python; see requirements/"
    return f"{what}; check the network, then run make again"


def build_failure(output: str, package: str) -> str:
    """Say in a few words why the build of an interface package failed, from what CMake and the compiler printed."""
    cause = re.search(r"^.*(?:CMake Error|error:|Error:|FAILED:).*(?:\n  .*)?", output, re.MULTILINE)
    return f"cannot build {package}: {' '.join(cause[0].split())[:200]}" if cause else f"cannot build {package}"
