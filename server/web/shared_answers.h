// Shares a page that takes long to make between the requests that wait for it.
//
//   auto round = answers.Join("/status.json");  // when the request arrives
//   ...
//   auto json = answers.Get(*round, [] { return MakePage(); });  // when it is its turn
//
// The requests that arrive until the page is begun form a round, and get one page. Therefore many
// readers wait until it was made twice at most, and none gets a page that is older than its
// request.
//
// Thread-safe. A round keeps its page until the last of its requests is answered.
#pragma once

#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/functional/function_ref.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"

namespace spikeserve {

class SharedAnswers {
 public:
  class Round {
   public:
    explicit Round(std::string key) : key_(std::move(key)) {}

   private:
    friend class SharedAnswers;

    const std::string key_;
    absl::Mutex mutex_;
    std::optional<absl::StatusOr<std::string>> answer_ ABSL_GUARDED_BY(mutex_);
  };

  // Adds a request for the page `key` to its round.
  std::shared_ptr<Round> Join(const std::string& key) {
    absl::MutexLock lock(&mutex_);
    std::erase_if(open_, [](const auto& item) { return item.second.expired(); });
    std::weak_ptr<Round>& open = open_[key];
    auto round = open.lock();
    if (round == nullptr) open = round = std::make_shared<Round>(key);
    return round;
  }

  // Returns the page of a round, which `make` makes for the first of its requests.
  absl::StatusOr<std::string> Get(Round& round,
                                  absl::FunctionRef<absl::StatusOr<std::string>()> make) {
    absl::MutexLock lock(&round.mutex_);
    if (!round.answer_.has_value()) {
      {
        absl::MutexLock open_lock(&mutex_);
        open_.erase(round.key_);  // who arrives from now on waits for the next one
      }
      round.answer_ = make();
    }
    return *round.answer_;
  }

 private:
  absl::Mutex mutex_;
  // Rounds whose page was not begun; expired ones are those whose requests were dropped.
  std::map<std::string, std::weak_ptr<Round>> open_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
