# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Install ba_node with colcon (ament_python) or pip.

The C++ kernels are built where pybind11 and a C++17 compiler are found; the package works without them, more slowly.
On x86-64 they are built for several processors; which one it is, is asked when they are imported (ba_node/native).
BA_NODE_TARGETS=baseline,avx2 builds some of them, BA_NODE_WERROR=1 makes the compiler's warnings errors.
"""

import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.develop import develop
from setuptools.command.install import install

NAME, MESSAGES = "ba_node", "ba_msgs"
SOURCES = Path(NAME) / "native" / "src"
# What is compiled once, and what once for each target.
COMMON = (
    "bindings/bal",
    "bindings/module",
    "bindings/patches",
    "bindings/steps",
    "bindings/views",
    "bindings/window",
    "targets/target",
    "adjustment/layout",
    "linalg/block_fill",
    "parallel/memory",
    "parallel/pool",
)
KERNELS = ("targets/kernel6", "targets/kernel9", "targets/functions")
# The narrowest first, in which order they have to be linked: simd/target.hpp says why. bindings/module.cpp asks the
# processor for what their flags take for granted.
TARGETS = ("baseline", "avx2", "avx512")


class Unit(NamedTuple):
    """A source, the folder of its object, and the flags that it is compiled with."""

    source: str
    folder: str
    flags: tuple[str, ...]


def wanted_targets() -> list[str]:
    """Return the targets to build."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return ["baseline"]
    wanted = os.environ.get("BA_NODE_TARGETS", "").split(",")
    return [name for name in TARGETS if wanted == [""] or name in wanted or name == "baseline"]


def flags_of(target: str) -> list[str]:
    """Return the compiler's flags for a target, or those for all of them (common)."""
    path = SOURCES / "targets" / f"{target}.flags"
    return path.read_text().split() if path.exists() else []


def units() -> list[Unit]:
    """Return what to compile, in the order to link it."""
    targets = wanted_targets()
    has = [f"-DBA_HAS_{name.upper()}" for name in targets]
    listed = [Unit(f"{name}.cpp", "common", tuple(has)) for name in COMMON]
    for target in targets:
        flags = (f"-DBA_TARGET={target}", *flags_of(target))
        listed += [Unit(f"{name}.cpp", target, flags) for name in KERNELS]
    return listed


def is_out_of_date(made: Path, sources: Iterable[str]) -> bool:
    """Return True if a file is missing or older than one that it is made of."""
    return not made.exists() or any(Path(source).stat().st_mtime > made.stat().st_mtime for source in sources)


class BuildKernels(build_ext):
    """Compiles each unit with flags of its own, on all cores."""

    def build_extension(self, ext: Extension) -> None:
        """Compile and link the kernels."""
        # Python's own flags ask for debug information, which is most of the size. Those that are given come last.
        given = shlex.split(os.environ.get("CXXFLAGS", ""))
        strict = ["-Werror"] if os.environ.get("BA_NODE_WERROR", "0") not in ("", "0") else []

        def compiled(unit: Unit) -> str:
            source, folder = str(SOURCES / unit.source), str(Path(self.build_temp) / unit.folder)
            (result,) = self.compiler.object_filenames([source], output_dir=folder)
            if self.force or is_out_of_date(Path(result), [source, __file__, *ext.depends]):
                flags = ["-g0", *flags_of("common"), *unit.flags, *strict, *given]
                self.compiler.compile([source], folder, include_dirs=ext.include_dirs, extra_postargs=flags)
            return str(result)

        listed = units()
        # The slowest ones, which are the widest targets' kernels, first.
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            jobs = {unit: pool.submit(compiled, unit) for unit in reversed(listed)}
        ext.extra_objects = [jobs[unit].result() for unit in listed]
        ext.sources, ext.depends = [], ext.extra_objects
        super().build_extension(ext)


def extensions() -> list[Extension]:
    """Return the C++ kernels, or nothing where pybind11 is missing."""
    try:
        import pybind11  # noqa: PLC0415 (only building needs it)
    except ImportError:
        print(
            "ba_node: no pybind11, so the C++ kernels are not built; the numpy kernels take their place",
            file=sys.stderr,
        )
        return []
    kernels = Extension(
        f"{NAME}.native._kernels",
        sources=[str(SOURCES / unit.source) for unit in units()],
        depends=[str(path) for path in sorted([*SOURCES.rglob("*.hpp"), *SOURCES.rglob("*.flags")])],
        include_dirs=[str(SOURCES), pybind11.get_include()],
        language="c++",
        # A compiler that fails leaves a package without kernels.
        optional=True,
    )
    return [kernels]


def shared(folder: str) -> list[tuple[str, list[str]]]:
    """List the files below a folder as data files of the package share, keeping its subfolders."""
    files = sorted(path for path in Path(folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    folders = sorted({path.parent for path in files})
    return [(f"share/{NAME}/{parent}", [str(path) for path in files if path.parent == parent]) for parent in folders]


def install_messages(prefix: Path, build: Path) -> None:
    """Build ba_msgs and install it, unless it is in the workspace or below it as a package of its own.

    colcon looks into no folder below a package, so that it finds ba_node alone; what ba_node cannot do without comes
    with it then.

    Args:
        prefix: where ba_node is installed.
        build: where it is built.
    """
    found = [Path(path) for path in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if path]
    # colcon leaves this file for a package that it has built. One of the last build here is to be built anew.
    apart = Path("share", "colcon-core", "packages", MESSAGES)
    others = [path for path in found if path.resolve() != prefix.resolve() and (path / "share" / MESSAGES).is_dir()]
    if not found or others or any((path / apart).is_file() for path in (prefix, prefix.parent / MESSAGES)):
        return
    settings = {"BUILD_TESTING": "OFF", "CMAKE_BUILD_TYPE": "Release", "CMAKE_INSTALL_PREFIX": prefix}
    settings["Python3_EXECUTABLE"] = sys.executable
    source = Path(__file__).resolve().parent / "msg_defs"
    defines = [f"-D{name}={value}" for name, value in settings.items()]
    subprocess.run(["cmake", "-S", source, "-B", build / MESSAGES, *defines], check=True)
    subprocess.run(["cmake", "--build", build / MESSAGES, "--target", "install", "--parallel"], check=True)


class Install(install):
    """As colcon installs; for a wheel or a Debian package, which have a root of their own, without ba_msgs."""

    def run(self) -> None:
        """Install."""
        super().run()
        if self.root is None:
            install_messages(Path(self.install_data), Path(self.get_finalized_command("build").build_base))


class Develop(develop):
    """As `colcon build --symlink-install` installs."""

    def run(self) -> None:
        """Install."""
        super().run()
        install, build = (self.get_finalized_command(name) for name in ("install", "build"))
        install_messages(Path(install.install_data), Path(build.build_base))


setup(
    name=NAME,
    cmdclass={"build_ext": BuildKernels, "develop": Develop, "install": Install},
    version="0.2.0",
    description="Bundle-adjustment back-end for ROS 2",
    maintainer="The ba_node Authors",
    maintainer_email="maintainers@example.com",
    license="Apache-2.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    # The definitions of ba_msgs, with which bags are read and written where ROS is not installed.
    package_data={
        NAME: ["py.typed"],
        f"{NAME}.io": ["ba_msgs/*.msg"],
        f"{NAME}.native": ["*.pyi"],
        f"{NAME}.offline": ["page.html"],
    },
    ext_modules=extensions(),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared("launch"),
        *shared("config"),
        *shared("bags"),
    ],
    python_requires=">=3.10",
    install_requires=[
        "matplotlib",
        "mcap",
        "numpy",
        "opencv-python-headless",
        "pyyaml",
        "rosbags",
        "scipy",
        "tqdm",
    ],
    # The extra named "test" with pytest in it is what makes `colcon test` run pytest.
    # Exact versions for development are in requirements/.
    extras_require={
        "test": ["hypothesis", "mcap-ros2-support", "pytest", "pytest-timeout"],
        # Optional parts, each of which says what to install where its library is missing.
        "front_end": ["poselib"],
        "report": ["plotly"],
        "tune": ["optuna>=5"],
        "fleet": ["distributed", "fsspec"],
        "geo": ["pymap3d"],
        "mpi": ["mpi4py"],
        "colmap": ["pycolmap"],
        "view": ["foxglove-sdk"],
        "completion": ["argcomplete"],
        "docs": ["furo", "myst-parser", "sphinx"],
        # Solvers that `make bench` compares with; each is left out where it is missing.
        "bench": ["g2opy", "gtsam", "pycolmap"],
        "lint": ["mypy", "ruff", "types-PyYAML", "types-tqdm"],
    },
    entry_points={
        "console_scripts": [
            "ba = ba_node.cli.main:main",
            "ba_adapter = ba_node.ros.tools.adapter:main",
            "ba_front_end = ba_node.ros.front_end.main:main",
            "ba_node = ba_node.ros.main:main",
        ],
        # So that the linter ament_copyright understands the second line of this file.
        "ament_copyright.license": ["apache2_spdx = ba_node.licence:APACHE2_SPDX"],
    },
    zip_safe=False,
)
