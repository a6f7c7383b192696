#include "core/environment/position_only.h"

#include <utility>

#include "core/environment/classic_tasks.h"

namespace spikeserve {

absl::string_view PositionOnly::InsideId(absl::string_view id) {
  if (id == kCartPoleId) return spikeserve::kCartPoleId;
  if (id == kPendulumId) return spikeserve::kPendulumId;
  return id;
}

std::unique_ptr<Environment> PositionOnly::MakeCartPole() {
  return Wrap(kCartPoleId, spikeserve::MakeCartPole());
}

std::unique_ptr<Environment> PositionOnly::MakePendulum() {
  return Wrap(kPendulumId, spikeserve::MakePendulum());
}

std::unique_ptr<Environment> PositionOnly::Wrap(absl::string_view id,
                                                std::unique_ptr<Environment> inside) {
  const bool is_cart = id == kCartPoleId;
  return std::make_unique<PositionOnly>(is_cart ? kCartPoleId : kPendulumId, std::move(inside),
                                        is_cart ? std::vector<int>{0, 2} : std::vector<int>{0, 1});
}

PositionOnly::PositionOnly(absl::string_view id, std::unique_ptr<Environment> inside,
                           std::vector<int> kept)
    : id_(id), inside_(std::move(inside)), kept_(std::move(kept)) {}

std::vector<float> PositionOnly::Reset(uint64_t seed) { return KeepEntries(inside_->Reset(seed)); }

std::vector<float> PositionOnly::ResetTo(absl::Span<const double> state) {
  return KeepEntries(inside_->ResetTo(state));
}

StepResult PositionOnly::Step(const Action& action) {
  StepResult result = inside_->Step(action);
  result.observation = KeepEntries(result.observation);
  return result;
}

std::vector<float> PositionOnly::KeepEntries(const std::vector<float>& observation) const {
  std::vector<float> shown;
  for (const int index : kept_) shown.push_back(observation[index]);
  return shown;
}

}  // namespace spikeserve
