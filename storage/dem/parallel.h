#pragma once
// run_jobs: jobs on worker threads, their outputs consumed on the calling thread, with a bound on what waits
// in between.

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <exception>
#include <functional>
#include <mutex>
#include <optional>
#include <thread>
#include <vector>

#include "kernels/types/result.h"

namespace lodestone {

// work(job, worker, emit) runs on `threads` threads for job = 0..count-1, begun in that order; emit(output)
// hands one output over and returns false when the work should stop. consume(output) runs on the calling
// thread, in any order of outputs. The first error, of either, ends everything and is returned; an exception
// of a worker becomes kInternal.
template <class Output>
Result<void> run_jobs(
    std::int64_t count, int threads, std::size_t max_waiting,
    const std::function<Result<void>(std::int64_t, int, const std::function<bool(Output&&)>&)>& work,
    const std::function<Result<void>(Output&&)>& consume) {
  std::mutex mutex;  // guards waiting, running, failure
  std::condition_variable is_changed;
  std::deque<Output> waiting;
  int running = threads;
  std::optional<Error> failure;
  std::atomic<bool> is_stopped{false};
  std::atomic<std::int64_t> next{0};

  const auto fail = [&](Error error) {
    const std::lock_guard lock(mutex);
    if (!failure) failure = std::move(error);
    is_stopped = true;
    is_changed.notify_all();
  };
  const std::function<bool(Output &&)> emit = [&](Output&& output) {
    std::unique_lock lock(mutex);
    is_changed.wait(lock, [&] { return is_stopped || waiting.size() < max_waiting; });
    if (is_stopped) return false;
    waiting.push_back(std::move(output));
    is_changed.notify_all();
    return true;
  };
  const auto worker_loop = [&](int worker) {
    try {
      for (std::int64_t job = next++; job < count && !is_stopped; job = next++) {
        if (auto ok = work(job, worker, emit); !ok) fail(std::move(ok.error()));
      }
    } catch (const std::exception& e) {
      fail(Error{ErrorCode::kInternal, std::string("ingest worker: ") + e.what()});
    }
    const std::lock_guard lock(mutex);
    --running;
    is_changed.notify_all();
  };

  std::vector<std::jthread> workers;
  for (int w = 0; w < threads; ++w) workers.emplace_back(worker_loop, w);
  for (;;) {
    std::unique_lock lock(mutex);
    is_changed.wait(lock, [&] { return is_stopped || !waiting.empty() || running == 0; });
    if (is_stopped || waiting.empty()) break;
    Output output = std::move(waiting.front());
    waiting.pop_front();
    is_changed.notify_all();
    lock.unlock();
    if (auto ok = consume(std::move(output)); !ok) fail(std::move(ok.error()));
  }
  workers.clear();  // joins
  if (failure) return std::move(*failure);
  return {};
}

}  // namespace lodestone
