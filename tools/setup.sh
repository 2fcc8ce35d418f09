#!/bin/sh
# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
# Bring .venv up to date with the Python named in PYTHON, or else the first suitable one.
set -u
cd "$(dirname "$0")/.." || exit 1

if [ -n "${PYTHON:-}" ]; then
  set -- "$PYTHON"
  options=--exact
else
  # -S: without the start-up hooks of the packages in .venv, which take most of the time.
  .venv/bin/python -ES -m tools.setup_env --check 2>/dev/null && exit 0
  set -- python3 python3.13 python3.12 python3.11 python3.10
  options=
fi

tried=
for python in "$@"; do
  version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || version='does not run'
  case $version in
    3.10 | 3.11 | 3.12 | 3.13) exec "$python" -E -m tools.setup_env $options ;;
  esac
  tried="$tried, $python ($version)"
done
echo "setup: no Python 3.10 to 3.13 found: tried ${tried#, }; choose one, for example: make PYTHON=python3.12 setup" >&2
exit 1
