// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Threads that share the tasks of a loop. What a task is depends on the problem alone, never on the number of
// threads, and nobody adds to what another writes: results are the same, bit for bit, for any number.
//
// Each thread has a queue of tasks, the same in every loop over as many: what it wrote in the loop before is in its
// own cache. The caller waits for tasks, not for threads: one that the system does not let run takes none, and its
// queue falls to the others.
#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

namespace ba {

class Worker;

class Pool {
 public:
  explicit Pool(int threads);
  ~Pool();
  Pool(const Pool&) = delete;
  Pool& operator=(const Pool&) = delete;

  int threads() const { return threads_; }

  // The first task of a thread's queue, of `count` tasks.
  std::int64_t begin_of_queue(std::int64_t count, int thread) const {
    return count / threads_ * thread + std::min<std::int64_t>(thread, count % threads_);
  }

  // Call f(task, thread) once for each task in [0, count), count < 2^32.
  template <class F>
  void each(std::int64_t count, F&& f) {
    if (threads_ == 1 || count <= 1) {
      for (std::int64_t i = 0; i < count; ++i) f(i, 0);
      return;
    }
    // No task can be had of the last round, nor yet of this one.
    const std::uint64_t round = ((queues_[0].next.load(std::memory_order_relaxed) >> 32) + 1) << 32;
    for (Queue& queue : queues_) queue.next.store(round | kTaskBits, std::memory_order_seq_cst);
    call_ = [](void* function, std::int64_t task, int thread) { (*static_cast<F*>(function))(task, thread); };
    function_ = const_cast<void*>(static_cast<const void*>(&f));
    done_.store(0, std::memory_order_relaxed);
    count_.store(count, std::memory_order_seq_cst);
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      for (int i = 0; i < threads_; ++i)
        queues_[i].next.store(round | static_cast<std::uint64_t>(begin_of_queue(count, i)), std::memory_order_release);
    }
    wake_.notify_all();
    take(0);
    for (int spin = 0; done_.load(std::memory_order_acquire) != count; ++spin) {
      relax();
      if (spin > kSpins) std::this_thread::yield();
    }
  }

 private:
  // Some hundred microseconds: loops follow one another with a little Python between them, and to wake a thread takes
  // as long as such a loop.
  static constexpr int kSpins = 4000;
  static constexpr std::uint64_t kTaskBits = 0xffffffff;

  static void relax() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
  }

  // The next task of a thread's queue: round in the upper half, task in the lower. A cache line each.
  struct alignas(64) Queue {
    std::atomic<std::uint64_t> next{0};
  };

  bool has_left(int thread, std::uint64_t next) const;
  bool is_waiting() const;
  void take(int thread);
  void work(int thread);

  const int threads_;
  std::vector<std::unique_ptr<Worker>> workers_;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::vector<Queue> queues_;
  alignas(64) std::atomic<std::int64_t> count_{0};  // tasks of the round
  alignas(64) std::atomic<std::int64_t> done_{0};
  std::atomic<bool> ending_{false};
  void (*call_)(void*, std::int64_t, int) = nullptr;
  void* function_ = nullptr;
};

}  // namespace ba
