// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include <cstddef>
#include <sstream>
#include <string>

#include "check.hpp"
#include "parallel/huge_pages.hpp"

static double free_mb(const std::string& text) {
  std::istringstream buddyinfo(text);
  return static_cast<double>(ba::free_in_huge_pages(buddyinfo)) / (1 << 20);
}

TEST(huge_pages_are_counted_in_all_zones) {
  CHECK_NEAR(
      free_mb("Node 0, zone      DMA      0      0      0      0      0      0      0      0      1      1      3 \n"
              "Node 0, zone    DMA32      2      3      0      2      3      2      1      4      4      2    752 \n"
              "Node 1, zone   Normal   3191   2748   1739   1202    635    331    658    520    216    132    306 \n"),
      2 * (1 + 2 + 132) + 4 * (3 + 752 + 306), 0);
}

TEST(memory_in_small_pieces_is_none) {
  CHECK_NEAR(free_mb("Node 0, zone   Normal  90000  80000  70000  60000  5000  400  300  200  100      0      0 \n"), 0,
             0);
  CHECK_NEAR(free_mb(""), 0, 0);
  CHECK_NEAR(free_mb("Node 0, zone   Normal\n"), 0, 0);
  CHECK_NEAR(free_mb("what is this\n\nNode"), 0, 0);
}
