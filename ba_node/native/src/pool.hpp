// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Threads that share the pieces of a loop. What a piece is depends on the problem alone, never on the number of
// threads, and nobody adds to what another writes: results are the same, bit for bit, for any number.
//
// The caller waits for pieces, not for threads: one that the system does not let run takes none, and its share falls to
// the others.
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
      ending_.store(true, std::memory_order_release);
    }
    wake_.notify_all();
    for (std::thread& worker : workers_) worker.join();
  }
  Pool(const Pool&) = delete;
  Pool& operator=(const Pool&) = delete;

  int threads() const { return threads_; }

  // Call f(piece, thread) once for each piece in [0, count), count < 2^32.
  template <class F>
  void each(std::int64_t count, F&& f) {
    if (threads_ == 1 || count <= 1) {
      for (std::int64_t i = 0; i < count; ++i) f(i, 0);
      return;
    }
    // No piece can be had of the last round, nor yet of this one.
    const std::uint64_t round = ((next_.load(std::memory_order_relaxed) >> 32) + 1) << 32;
    next_.store(round | kPieces, std::memory_order_seq_cst);
    call_ = [](void* function, std::int64_t piece, int thread) { (*static_cast<F*>(function))(piece, thread); };
    function_ = const_cast<void*>(static_cast<const void*>(&f));
    done_.store(0, std::memory_order_relaxed);
    count_.store(static_cast<std::uint64_t>(count), std::memory_order_seq_cst);
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      next_.store(round, std::memory_order_release);
    }
    wake_.notify_all();
    take(0);
    for (int spin = 0; done_.load(std::memory_order_acquire) != static_cast<std::uint64_t>(count); ++spin) {
      relax();
      if (spin > kSpins) std::this_thread::yield();
    }
  }

 private:
  // Some hundred microseconds: loops follow one another with a little Python between them, and to wake a thread takes
  // as long as such a loop.
  static constexpr int kSpins = 4000;
  static constexpr std::uint64_t kPieces = 0xffffffff;

  static void relax() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
  }

  bool is_waiting() const {
    return (next_.load(std::memory_order_acquire) & kPieces) >= count_.load(std::memory_order_acquire);
  }

  // Take pieces of the current round until none is left. Whoever moves next_ on has the piece: the round cannot end
  // before it is done, so call_ and function_ are of that round.
  void take(int thread) {
    std::uint64_t next = next_.load(std::memory_order_acquire);
    while ((next & kPieces) < count_.load(std::memory_order_acquire)) {
      if (!next_.compare_exchange_weak(next, next + 1, std::memory_order_acq_rel, std::memory_order_acquire)) continue;
      call_(function_, static_cast<std::int64_t>(next & kPieces), thread);
      done_.fetch_add(1, std::memory_order_acq_rel);
      next = next_.load(std::memory_order_acquire);
    }
  }

  void work(int thread) {
    while (true) {
      for (int spin = 0; spin < kSpins && is_waiting() && !ending_.load(std::memory_order_acquire); ++spin) relax();
      if (is_waiting()) {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [this] { return ending_.load(std::memory_order_acquire) || !is_waiting(); });
      }
      if (ending_.load(std::memory_order_acquire)) return;
      take(thread);
    }
  }

  const int threads_;
  std::vector<std::thread> workers_;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::atomic<std::uint64_t> next_{0};   // round in the upper half, next piece in the lower
  std::atomic<std::uint64_t> count_{0};  // pieces of the round
  std::atomic<std::uint64_t> done_{0};
  std::atomic<bool> ending_{false};
  void (*call_)(void*, std::int64_t, int) = nullptr;
  void* function_ = nullptr;
};

}  // namespace ba
