#!/bin/sh
# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
#
# Run the tests in C++ under AddressSanitizer, UndefinedBehaviourSanitizer and ThreadSanitizer; then build the kernels
# with the first two into out/sanitize/, and run their tests in Python there.
# usage: tools/sanitize.sh [arguments of pytest]
set -eu
cd "$(dirname "$0")/.."
python=$(pwd)/${PYTHON:-.venv/bin/python}
case ${PYTHON:-} in /*) python=$PYTHON ;; esac
sh tools/native_tests.sh address undefined thread
rm -rf out/sanitize
mkdir -p out/sanitize
cp -r ba_node experiments tests setup.py setup.cfg package.xml pyproject.toml resource launch config bags out/sanitize/
cd out/sanitize
rm -f ba_node/native/*.so
# setuptools reads CXXFLAGS for C++, older ones CFLAGS. -O3 would take far longer to compile.
flags="-fPIC -O1 -g1 -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer"
BA_NODE_TARGETS=baseline BA_NODE_WERROR=1 CFLAGS=$flags CXXFLAGS=$flags \
  LDFLAGS="-fsanitize=address,undefined" "$python" setup.py -q build_ext --inplace
# Without them the tests would pass by themselves.
nm ba_node/native/*.so | grep -q __asan
[ $# -gt 0 ] || set -- tests/core/test_kernels.py tests/core/test_inner_iterations.py tests/core/test_threads.py tests/core/test_linear_solvers.py
# Python itself leaks on purpose, and loads the sanitizers' library only if told to.
LD_PRELOAD="$(g++ -print-file-name=libasan.so) $(g++ -print-file-name=libstdc++.so.6)" \
  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 "$python" -m pytest -q -p no:cacheprovider "$@"
