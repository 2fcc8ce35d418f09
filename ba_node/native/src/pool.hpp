// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Threads that share the pieces of a loop. What a piece is depends on the problem alone, never on the number of
// threads, and nobody adds to what another writes: results are the same, bit for bit, for any number.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <thread>
#include <vector>

namespace ba {

class Pool {
 public:
  explicit Pool(int threads) : threads_(threads < 1 ? 1 : threads) {
    for (int i = 1; i < threads_; ++i) workers_.emplace_back([this, i] { work(i); });
  }
  ~Pool() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      ending_ = true;
      round_.fetch_add(1, std::memory_order_release);
    }
    wake_.notify_all();
    for (std::thread& worker : workers_) worker.join();
  }
  Pool(const Pool&) = delete;
  Pool& operator=(const Pool&) = delete;

  int threads() const { return threads_; }

  // Call f(piece, thread) once for each piece in [0, count).
  template <class F>
  void each(std::int64_t count, F&& f) {
    if (threads_ == 1 || count <= 1) {
      for (std::int64_t i = 0; i < count; ++i) f(i, 0);
      return;
    }
    call_ = [](void* function, std::int64_t piece, int thread) { (*static_cast<F*>(function))(piece, thread); };
    function_ = const_cast<void*>(static_cast<const void*>(&f));
    count_ = count;
    next_.store(0, std::memory_order_relaxed);
    busy_.store(threads_ - 1, std::memory_order_relaxed);
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      round_.fetch_add(1, std::memory_order_release);
    }
    wake_.notify_all();
    take(0);
    for (int spin = 0; busy_.load(std::memory_order_acquire) != 0; ++spin) {
      relax();
      if (spin > kSpins) std::this_thread::yield();
    }
  }

 private:
  // Some hundred microseconds: loops follow one another with a little Python between them, and to wake a thread takes
  // as long as such a loop.
  static constexpr int kSpins = 4000;

  static void relax() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
  }

  void take(int thread) {
    for (std::int64_t i = next_.fetch_add(1); i < count_; i = next_.fetch_add(1)) call_(function_, i, thread);
  }

  void work(int thread) {
    std::uint64_t seen = 0;
    while (true) {
      for (int spin = 0; spin < kSpins && round_.load(std::memory_order_acquire) == seen; ++spin) relax();
      if (round_.load(std::memory_order_acquire) == seen) {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [&] { return round_.load(std::memory_order_acquire) != seen; });
      }
      seen = round_.load(std::memory_order_acquire);
      if (ending_) return;
      take(thread);
      busy_.fetch_sub(1, std::memory_order_release);
    }
  }

  const int threads_;
  std::vector<std::thread> workers_;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::atomic<std::uint64_t> round_{0};
  std::atomic<std::int64_t> next_{0};
  std::atomic<int> busy_{0};
  bool ending_ = false;
  void (*call_)(void*, std::int64_t, int) = nullptr;
  void* function_ = nullptr;
  std::int64_t count_ = 0;
};

}  // namespace ba
