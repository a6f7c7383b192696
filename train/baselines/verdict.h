// Says in words and numbers how good a policy is, and what to try, at the end of a command.
//
// Plain values and free functions without shared state. Example:
//   const PolicyVerdict verdict = Judge(comparison, ActionNames(dataset), loss_fall);
//   std::fputs(ToText(verdict).c_str(), stdout);
//   return CheckGrade(verdict, least);
#pragma once

#include <array>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "core/base/enum_names.h"
#include "core/dataset/dataset.h"
#include "nlohmann/json.hpp"
#include "train/baselines/comparison.h"

namespace spikeserve {

enum class Grade { kBad, kWeak, kGood };

constexpr std::array<EnumName<Grade>, 3> EnumNames(Grade) {
  return {{{Grade::kBad, "bad"}, {Grade::kWeak, "weak"}, {Grade::kGood, "good"}}};
}

struct PolicyVerdict {
  Grade grade = Grade::kWeak;
  std::string reason;               // one sentence, with the figures
  std::vector<std::string> advice;  // what to try, the most promising first; none if good
  nlohmann::ordered_json figures = nlohmann::ordered_json::object();  // of the reason
};

// Returns the names of the elements of an action, [act], as the data have them, or their numbers
// from 0 on; none for a Discrete space.
std::vector<std::string> ActionNames(const Dataset& dataset);

// Returns the share by which a validation loss fell during the last tenth of a training, and
// nothing without validations in both parts. `losses` has (iteration, loss) in order.
std::optional<double> LossFall(const std::vector<std::pair<int, double>>& losses);

// Judges by the share of the actions of held-out steps that a policy explains. Bad: below a
// quarter, or below half of what the best baseline explains. Weak: below half; by more than 5
// points less than the best baseline, and by two standard errors; or the loss still fell, by more
// than 3 %
// (`loss_fall`). Weak, too, without a comparison, because nothing was measured.
PolicyVerdict Judge(const std::optional<BaselineComparison>& comparison,
                    const std::vector<std::string>& names, std::optional<double> loss_fall);

// Returns "verdict: ..." and a line "try: ..." for each advice.
std::string ToText(const PolicyVerdict& verdict);

// Returns the grade, the figures, the reason and the advice.
nlohmann::ordered_json ToJson(const PolicyVerdict& verdict);

// Returns FAILED_PRECONDITION, which names --require, if the grade is below `least`.
absl::Status CheckGrade(const PolicyVerdict& verdict, Grade least);

}  // namespace spikeserve
