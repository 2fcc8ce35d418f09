// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// How much memory Linux has at hand in pages of 2 MB. Where it has none it moves others aside while the process that
// asks for one waits, which takes longer than a solve gains.
#pragma once

#include <cstddef>
#include <istream>
#include <sstream>
#include <string>

namespace ba {

constexpr std::size_t kHugePage = std::size_t{1} << 21;

// Bytes in free pieces of 2 MB and more, of what /proc/buddyinfo holds: lines such as "Node 0, zone Normal 7 5 ...",
// with the number of free pieces of 4 KiB, then of 8 KiB, and so on. 0 if there is nothing to be read.
inline std::size_t free_in_huge_pages(std::istream& buddyinfo) {
  constexpr std::size_t kSmallPage = 4096;
  std::size_t total = 0;
  std::string line, word;
  while (std::getline(buddyinfo, line)) {
    std::istringstream words(line);
    for (int i = 0; i < 4; ++i) words >> word;  // Node, number, zone, name
    std::size_t size = kSmallPage, count = 0;
    for (; words >> count; size *= 2)
      if (size >= kHugePage) total += count * size;
  }
  return total;
}

}  // namespace ba
