// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include "parallel/pool.hpp"

#include <pthread.h>
#include <sched.h>

#include <functional>
#include <utility>

namespace ba {

// A thread that begins on another core than the one that makes it. Linux often starts a thread where its maker runs,
// and there it waits for the maker to be preempted, a millisecond or more, as that never sleeps: most of a window's
// solve.
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

Pool::Pool(int threads) : threads_(threads < 1 ? 1 : threads), queues_(threads_) {
  for (int i = 1; i < threads_; ++i) workers_.push_back(std::make_unique<Worker>([this, i] { work(i); }));
}

Pool::~Pool() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    ending_.store(true, std::memory_order_release);
  }
  wake_.notify_all();
  workers_.clear();
}

// Whether a queue has tasks left, by its next one.
bool Pool::has_left(int thread, std::uint64_t next) const {
  return (next & kTaskBits) <
         static_cast<std::uint64_t>(begin_of_queue(count_.load(std::memory_order_acquire), thread + 1));
}

bool Pool::is_waiting() const {
  for (int i = 0; i < threads_; ++i)
    if (has_left(i, queues_[i].next.load(std::memory_order_acquire))) return false;
  return true;
}

// Take tasks of the current round until none is left, first of the own queue. Whoever moves next on has the task: the
// round cannot end before it is done, so call_ and function_ are of that round.
void Pool::take(int thread) {
  for (int i = 0; i < threads_; ++i) {
    const int of = (thread + i) % threads_;
    std::atomic<std::uint64_t>& queue = queues_[of].next;
    std::uint64_t next = queue.load(std::memory_order_acquire);
    while (has_left(of, next)) {
      if (!queue.compare_exchange_weak(next, next + 1, std::memory_order_acq_rel, std::memory_order_acquire)) continue;
      call_(function_, static_cast<std::int64_t>(next & kTaskBits), thread);
      done_.fetch_add(1, std::memory_order_acq_rel);
      next = queue.load(std::memory_order_acquire);
    }
  }
}

void Pool::work(int thread) {
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

}  // namespace ba
