// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// The least that tests in C++ need, so that they build wherever a compiler is: TEST, CHECK, CHECK_NEAR, and main in
// check.cpp. A test goes on after a check that fails.
#pragma once

#include <cmath>
#include <cstdio>
#include <vector>

namespace check {

struct Test {
  const char* name;
  void (*run)();
};

std::vector<Test>& tests();
// Count a check that failed and say where.
void fail(const char* file, int line, const char* text, double got, double wanted);

struct Registered {
  Registered(const char* name, void (*run)()) { tests().push_back({name, run}); }
};

}  // namespace check

#define TEST(name)                                     \
  static void name();                                  \
  static const check::Registered name##_(#name, name); \
  static void name()

#define CHECK(condition) \
  if (!(condition)) check::fail(__FILE__, __LINE__, #condition, 0, 1)

// Written so that what is not a number fails.
#define CHECK_NEAR(got, wanted, tolerance)                                                       \
  if (const double got_ = (got), wanted_ = (wanted); !(std::abs(got_ - wanted_) <= (tolerance))) \
  check::fail(__FILE__, __LINE__, #got, got_, wanted_)
