// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include <atomic>
#include <cstdint>
#include <thread>
#include <vector>

#include "check.hpp"
#include "parallel/pool.hpp"

using ba::Pool;

TEST(each_task_is_done_once) {
  for (const int threads : {1, 2, 3, 8}) {
    Pool pool(threads);
    CHECK(pool.threads() == threads);
    for (const std::int64_t count : {0, 1, 2, 7, 100, 1000}) {
      // Not atomic: whoever does a task has it alone, and the caller sees all of it after.
      std::vector<int> done(count, 0);
      for (int round = 0; round < 20; ++round) pool.each(count, [&](std::int64_t task, int) { ++done[task]; });
      for (int times : done) CHECK(times == 20);
    }
  }
}

TEST(threads_have_numbers_of_their_own) {
  Pool pool(4);
  std::vector<std::int64_t> sums(4, 0);
  for (int round = 0; round < 100; ++round) pool.each(64, [&](std::int64_t task, int thread) { sums[thread] += task; });
  std::int64_t total = 0;
  for (std::int64_t sum : sums) total += sum;
  CHECK(total == 100 * 64 * 63 / 2);
}

TEST(queues_cover_all_tasks) {
  Pool pool(3);
  for (const std::int64_t count : {1, 2, 3, 4, 10, 11}) {
    CHECK(pool.begin_of_queue(count, 0) == 0);
    CHECK(pool.begin_of_queue(count, 3) == count);
    for (int thread = 0; thread < 3; ++thread) {
      const std::int64_t size = pool.begin_of_queue(count, thread + 1) - pool.begin_of_queue(count, thread);
      CHECK(size >= count / 3 && size <= count / 3 + 1);
    }
  }
}

TEST(a_slow_task_does_not_keep_others_waiting) {
  Pool pool(2);
  std::atomic<int> others{0};
  // The first task waits for all others: whoever has it, the other thread does the rest.
  pool.each(50, [&](std::int64_t task, int) {
    if (task != 0) {
      others.fetch_add(1);
      return;
    }
    while (others.load() < 49) std::this_thread::yield();
  });
  CHECK(others.load() == 49);
}

TEST(fewer_than_one_thread_is_one) {
  Pool pool(0);
  int done = 0;
  pool.each(5, [&](std::int64_t, int) { ++done; });
  CHECK(done == 5);
}
