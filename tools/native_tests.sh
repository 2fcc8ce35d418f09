#!/bin/sh
# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
#
# Build the tests in C++ (tests/native/) into out/native/ and run them: as they are (plain), under a sanitizer, or for
# another processor under an emulator (aarch64; left out, and said, where compiler or emulator are missing).
# usage: tools/native_tests.sh [plain|address|undefined|thread|aarch64]...
set -eu
cd "$(dirname "$0")/.."
PATH=$(pwd)/.venv/bin:$PATH
[ $# -gt 0 ] || set -- plain
for kind in "$@"; do
  case $kind in
    plain) options= ;;
    address | undefined | thread) options="-DSANITIZE=$kind -DWITH_KERNELS=ON" ;;
    aarch64)
      for program in aarch64-linux-gnu-g++ qemu-aarch64; do
        command -v $program >/dev/null && continue
        echo "native tests: aarch64 left out: no $program (Debian: g++-aarch64-linux-gnu, qemu-user)"
        continue 2
      done
      options="-DWITH_KERNELS=ON -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64
        -DCMAKE_CXX_COMPILER=aarch64-linux-gnu-g++ -DCMAKE_CROSSCOMPILING_EMULATOR=qemu-aarch64"
      ;;
    *) echo "native tests: $kind: choose among plain, address, undefined, thread, aarch64" >&2 && exit 2 ;;
  esac
  echo "native tests: $kind"
  # shellcheck disable=SC2086 (a list of options)
  cmake -S tests/native -B "out/native/$kind" -G Ninja $options >/dev/null
  cmake --build "out/native/$kind" -- -k 0
  ctest --test-dir "out/native/$kind" --output-on-failure
done
