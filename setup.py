# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Install ba_node with colcon (ament_python) or pip.

The C++ kernels are built where pybind11 and a C++17 compiler are found; the package works without them, more slowly.
BA_NODE_PORTABLE=1 builds kernels that run on other processors than this one.
"""

import os
import subprocess
import sys
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.develop import develop
from setuptools.command.install import install

NAME, MESSAGES = "ba_node", "ba_msgs"


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
    sources = Path(NAME) / "native" / "src"
    # Without -ffast-math, which would remove the tests for numbers that are not finite.
    flags = ["-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-Wno-psabi"]
    if os.environ.get("BA_NODE_PORTABLE", "0") in ("", "0"):
        flags.append("-march=native")
    kernels = Extension(
        f"{NAME}.native._kernels",
        sources=[str(sources / "bindings" / "module.cpp")],
        depends=[str(path) for path in sorted(sources.rglob("*.hpp"))],
        include_dirs=[str(sources), pybind11.get_include()],
        extra_compile_args=flags,
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
    cmdclass={"develop": Develop, "install": Install},
    version="0.1.0",
    description="Bundle-adjustment back-end for ROS 2",
    maintainer="The ba_node Authors",
    maintainer_email="maintainers@example.com",
    license="Apache-2.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    # The definitions of ba_msgs, with which bags are read and written where ROS is not installed.
    package_data={NAME: ["py.typed"], f"{NAME}.io": ["ba_msgs/*.msg"]},
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
        # Solvers that `make bench` compares with; each is left out where it is missing.
        "bench": ["g2opy", "gtsam", "pycolmap"],
        "lint": ["mypy", "ruff", "types-PyYAML", "types-tqdm"],
    },
    entry_points={
        "console_scripts": [
            "ba = ba_node.cli.main:main",
            "ba_adapter = ba_node.ros.tools.adapter:main",
            "ba_node = ba_node.ros.main:main",
        ],
        # So that the linter ament_copyright understands the second line of this file.
        "ament_copyright.license": ["apache2_spdx = ba_node.licence:APACHE2_SPDX"],
    },
    zip_safe=False,
)
