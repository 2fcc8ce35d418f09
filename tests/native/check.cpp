// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include "check.hpp"

#include <cstring>

#define BA_QUOTED(name) #name
#define BA_NAME(name) BA_QUOTED(name)

namespace check {

namespace {
int failures = 0;

// Whether this processor runs what the tests are compiled for.
bool is_supported(const char* target) {
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (std::strcmp(target, "avx2") == 0) return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (std::strcmp(target, "avx512") == 0)
    return __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
#endif
  return std::strcmp(target, "baseline") == 0;
}
}  // namespace

std::vector<Test>& tests() {
  static std::vector<Test> all;
  return all;
}

void fail(const char* file, int line, const char* text, double got, double wanted) {
  ++failures;
  std::printf("%s:%d: %s: got %.17g, wanted %.17g\n", file, line, text, got, wanted);
}

}  // namespace check

int main() {
  const char* target = BA_NAME(BA_TARGET);
  if (!check::is_supported(target)) {
    std::printf("%s: not on this processor\n", target);
    return 77;
  }
  int failed = 0;
  for (const check::Test& test : check::tests()) {
    const int before = check::failures;
    test.run();
    if (check::failures != before) {
      ++failed;
      std::printf("failed: %s\n", test.name);
    }
  }
  std::printf("%s: %zu passed, %d failed\n", target, check::tests().size() - failed, failed);
  return failed == 0 && !check::tests().empty() ? 0 : 1;
}
