# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Repeat the experiments of the thesis: what is run is data (catalogue.py), each run is one recorded JSON file.

tasks.py says what can be run, runner.py runs it and keeps the records, tables.py and plots.py make tables and pictures
from records alone, report.py puts them on pages, claims.py checks by them what the thesis says.
"""
