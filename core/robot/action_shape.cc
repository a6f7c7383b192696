#include "core/robot/action_shape.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace spikeserve::robot {
namespace {

bool IsUtf8(std::string_view text) {
  for (size_t i = 0; i < text.size();) {
    const auto byte = [&](size_t at) {
      return at < text.size() ? static_cast<unsigned char>(text[at]) : 0U;
    };
    const unsigned first = byte(i);
    const size_t more = first < 0x80 ? 0 : first < 0xE0 ? 1 : first < 0xF0 ? 2 : 3;
    uint32_t code = more == 0 ? first : first & (0x3FU >> more);
    for (size_t k = 1; k <= more; ++k) {
      if ((byte(i + k) & 0xC0U) != 0x80) return false;
      code = code << 6 | (byte(i + k) & 0x3FU);
    }
    constexpr uint32_t kLeast[] = {0, 0x80, 0x800, 0x10000};  // that needs so many bytes
    const bool is_valid = code >= kLeast[more] && code <= 0x10FFFF && code >> 11 != 0x1B;
    if (!is_valid || (first >= 0x80 && first < 0xC0) || first >= 0xF8) return false;
    i += more + 1;
  }
  return true;
}

}  // namespace

bool IsValid(const ChooserView& chooser) {
  const size_t most = chooser.kind == Chooser::kOperator ? kLongestOperatorId : 0;
  return chooser.kind <= Chooser::kHold && chooser.operator_id.size() <= most &&
         IsUtf8(chooser.operator_id);
}

ChooserView Fit(const ChooserView& chooser) {
  if (IsValid(chooser)) return chooser;
  return {.kind = chooser.kind <= Chooser::kHold ? chooser.kind : Chooser::kUnknown};
}

bool IsEqual(const ActionView& a, const ActionView& b) {
  return a.discrete == b.discrete && std::equal(a.continuous.begin(), a.continuous.end(),
                                                b.continuous.begin(), b.continuous.end());
}

ActionShape::ActionShape(int64_t n, std::vector<float> low, std::vector<float> high)
    : n_(n), low_(std::move(low)), high_(std::move(high)) {}

bool ActionShape::Fit(const ActionView& action, ActionValue* fitted) const {
  if (!is_box()) {
    if (action.discrete < 0 || action.discrete >= n_) return false;
    fitted->discrete = action.discrete;
    return true;
  }
  const auto is_finite = [](float value) { return std::isfinite(value); };
  if (action.continuous.size() != size()) return false;
  if (!std::all_of(action.continuous.begin(), action.continuous.end(), is_finite)) return false;
  fitted->continuous.resize(size());
  for (size_t i = 0; i < size(); ++i) {
    fitted->continuous[i] = std::clamp(action.continuous[i], low_[i], high_[i]);
  }
  return true;
}

}  // namespace spikeserve::robot
