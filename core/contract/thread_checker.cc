#include "core/contract/thread_checker.h"

namespace spikeserve {

void ThreadChecker::Bind() {
  const std::thread::id before = thread_.exchange(std::this_thread::get_id());
  SPIKESERVE_DCHECK(before == std::thread::id());
}

void ThreadChecker::Release() {
  const std::thread::id before = thread_.exchange(std::thread::id());
  SPIKESERVE_DCHECK(before == std::this_thread::get_id());
}

bool ThreadChecker::IsCurrent() const {
  const std::thread::id bound = thread_.load();
  return bound == std::thread::id() || bound == std::this_thread::get_id();
}

}  // namespace spikeserve
