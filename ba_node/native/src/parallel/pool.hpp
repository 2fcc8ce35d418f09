// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Threads that share the pieces of a loop. What a piece is depends on the problem alone, never on the number of
// threads, and nobody adds to what another writes: results are the same, bit for bit, for any number.
//
// Each thread has a share of the pieces, the same in every loop over as many: what it wrote in the loop before is in its
// own cache. The caller waits for pieces, not for threads: one that the system does not let run takes none, and its share
// falls to the others.
#pragma once

#include <pthread.h>
#include <sched.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

namespace ba {

// A thread that begins on another core than the one that makes it. Linux often starts a thread where its maker runs, and
// there it waits for the maker to be preempted, a millisecond or more, as that never sleeps: most of a window's solve.
class Worker {
 public:
  explicit Worker(std::function<void()> work) : work_(std::move(work)) {
    pthread_attr_t attributes;
    pthread_attr_init(&attributes);
#if defined(__linux__)
    if (sched_getaffinity(0, sizeof(cores_), &cores_) == 0) {
      cpu_set_t others = cores_;
      CPU_CLR(sched_getcpu(), &others);
      if (CPU_COUNT(&others) > 0) pthread_attr_setaffinity_np(&attributes, sizeof(others), &others);
    }
#endif
    // Anywhere, if the other cores have been taken away meanwhile. With no thread at all the pool does without it.
    runs_ = pthread_create(&thread_, &attributes, &Worker::run, this) == 0 ||
            pthread_create(&thread_, nullptr, &Worker::run, this) == 0;
    pthread_attr_destroy(&attributes);
  }
  ~Worker() {
    if (runs_) pthread_join(thread_, nullptr);
  }
  Worker(const Worker&) = delete;
  Worker& operator=(const Worker&) = delete;

 private:
  static void* run(void* self) {
    auto* worker = static_cast<Worker*>(self);
#if defined(__linux__)
    // From now on it may be moved.
    if (CPU_COUNT(&worker->cores_) > 0) sched_setaffinity(0, sizeof(cpu_set_t), &worker->cores_);
#endif
    worker->work_();
    return nullptr;
  }

  std::function<void()> work_;
#if defined(__linux__)
  cpu_set_t cores_{};
#endif
  pthread_t thread_{};
  bool runs_ = false;
};

class Pool {
 public:
  explicit Pool(int threads) : threads_(threads < 1 ? 1 : threads), shares_(threads_) {
    for (int i = 1; i < threads_; ++i) workers_.push_back(std::make_unique<Worker>([this, i] { work(i); }));
  }
  ~Pool() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      ending_.store(true, std::memory_order_release);
    }
    wake_.notify_all();
    workers_.clear();
  }
  Pool(const Pool&) = delete;
  Pool& operator=(const Pool&) = delete;

  int threads() const { return threads_; }

  // Where the share of a thread begins, of `count` pieces.
  std::int64_t share(std::int64_t count, int thread) const {
    return count / threads_ * thread + std::min<std::int64_t>(thread, count % threads_);
  }

  // Call f(piece, thread) once for each piece in [0, count), count < 2^32.
  template <class F>
  void each(std::int64_t count, F&& f) {
    if (threads_ == 1 || count <= 1) {
      for (std::int64_t i = 0; i < count; ++i) f(i, 0);
      return;
    }
    // No piece can be had of the last round, nor yet of this one.
    const std::uint64_t round = ((shares_[0].next.load(std::memory_order_relaxed) >> 32) + 1) << 32;
    for (Share& share : shares_) share.next.store(round | kPieces, std::memory_order_seq_cst);
    call_ = [](void* function, std::int64_t piece, int thread) { (*static_cast<F*>(function))(piece, thread); };
    function_ = const_cast<void*>(static_cast<const void*>(&f));
    done_.store(0, std::memory_order_relaxed);
    count_.store(count, std::memory_order_seq_cst);
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      for (int i = 0; i < threads_; ++i)
        shares_[i].next.store(round | static_cast<std::uint64_t>(share(count, i)), std::memory_order_release);
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
  static constexpr std::uint64_t kPieces = 0xffffffff;

  static void relax() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
  }

  // The next pieces of a thread's share: round in the upper half, piece in the lower. A cache line each.
  struct alignas(64) Share {
    std::atomic<std::uint64_t> next{0};
  };

  // Whether a share has pieces left, by its next one.
  bool has_left(int thread, std::uint64_t next) const {
    return (next & kPieces) < static_cast<std::uint64_t>(share(count_.load(std::memory_order_acquire), thread + 1));
  }

  bool is_waiting() const {
    for (int i = 0; i < threads_; ++i)
      if (has_left(i, shares_[i].next.load(std::memory_order_acquire))) return false;
    return true;
  }

  // Take pieces of the current round until none is left, first of the own share. Whoever moves next on has the piece: the
  // round cannot end before it is done, so call_ and function_ are of that round.
  void take(int thread) {
    for (int i = 0; i < threads_; ++i) {
      const int of = (thread + i) % threads_;
      std::atomic<std::uint64_t>& share = shares_[of].next;
      std::uint64_t next = share.load(std::memory_order_acquire);
      while (has_left(of, next)) {
        if (!share.compare_exchange_weak(next, next + 1, std::memory_order_acq_rel, std::memory_order_acquire)) continue;
        call_(function_, static_cast<std::int64_t>(next & kPieces), thread);
        done_.fetch_add(1, std::memory_order_acq_rel);
        next = share.load(std::memory_order_acquire);
      }
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
  std::vector<std::unique_ptr<Worker>> workers_;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::vector<Share> shares_;
  alignas(64) std::atomic<std::int64_t> count_{0};  // pieces of the round
  alignas(64) std::atomic<std::int64_t> done_{0};
  std::atomic<bool> ending_{false};
  void (*call_)(void*, std::int64_t, int) = nullptr;
  void* function_ = nullptr;
};

}  // namespace ba
