#!/bin/sh
# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
#
# Build a wheel into out/wheel/ that other Linux machines can install, and try it: in a fresh environment, without a
# compiler.
set -eu
cd "$(dirname "$0")/.."
PATH=$(pwd)/.venv/bin:$PATH
rm -rf out/wheel
mkdir -p out/wheel
python -m pip wheel -q --no-deps --no-build-isolation -w out/wheel/built .
# Fails if there are no kernels in it, and names the oldest systems that it runs on.
auditwheel repair -w out/wheel out/wheel/built/*.whl
rm -r out/wheel/built
python -m venv out/wheel/venv
CC=false CXX=false out/wheel/venv/bin/python -m pip install -q --only-binary :all: out/wheel/*.whl
cd out/wheel
version=$(venv/bin/ba --version)
echo "$version"
case $version in *"kernels: C++"*) ;; *) echo "wheel: it has no C++ kernels" >&2 && exit 1 ;; esac
venv/bin/ba replay ../../bags/stereo_loop.mcap --out replay >/dev/null
rm -r replay venv
ls ./*.whl
