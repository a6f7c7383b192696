#include "server/web/shared_answers.h"

namespace spikeserve {

std::shared_ptr<SharedAnswers::Round> SharedAnswers::Join(const std::string& key) {
  absl::MutexLock lock(&mutex_);
  std::erase_if(open_, [](const auto& item) { return item.second.expired(); });
  std::weak_ptr<Round>& open = open_[key];
  auto round = open.lock();
  if (round == nullptr) open = round = std::make_shared<Round>(key);
  return round;
}

absl::StatusOr<std::string> SharedAnswers::Get(
    Round& round, absl::FunctionRef<absl::StatusOr<std::string>()> make) {
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

}  // namespace spikeserve
