#include "train/baselines/verdict.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "core/base/rounded.h"

namespace spikeserve {
namespace {

constexpr double kBadShare = 0.25, kWeakShare = 0.5;
constexpr double kBadOfBaseline = 0.5;  // of what the best baseline explains
constexpr double kBehind = 0.05;        // less than the best baseline
constexpr double kFalling = 0.03;

std::string Percent(double share) { return absl::StrFormat("%.0f %%", Rounded(100.0 * share, 0)); }

// Returns the baseline that explains most.
const BaselineScore& BestOf(const BaselineComparison& comparison) {
  return *std::max_element(comparison.baselines.begin(), comparison.baselines.end(),
                           [](const BaselineScore& a, const BaselineScore& b) {
                             return a.error.explained < b.error.explained;
                           });
}

// Returns " (hip 71 %, knee 53 %)", or nothing for one element.
std::string ElementsText(const ImitationError& error, const std::vector<std::string>& names) {
  if (error.explained_elements.size() < 2) return "";
  std::vector<std::string> parts;
  for (size_t i = 0; i < error.explained_elements.size(); ++i) {
    parts.push_back(absl::StrCat(names[i], " ", Percent(error.explained_elements[i])));
  }
  return absl::StrCat(" (", absl::StrJoin(parts, ", "), ")");
}

void JudgeFit(const BaselineComparison& comparison, const std::vector<std::string>& names,
              PolicyVerdict* verdict) {
  const double share = comparison.policy.explained;
  const BaselineScore& best = BestOf(comparison);
  const double reachable = best.error.explained;
  const bool is_behind =
      reachable - share > kBehind && Compare(comparison.policy, best.error).is_significant();
  // Not below the bound: a share that could not be measured is no number.
  if (!(share >= kBadShare) || (is_behind && share < kBadOfBaseline * reachable)) {
    verdict->grade = Grade::kBad;
  } else if (share < kWeakShare || is_behind) {
    verdict->grade = Grade::kWeak;
  }
  verdict->reason = absl::StrFormat(
      "it explains %s of the actions of %s steps%s, the best baseline (%s) %s", Percent(share),
      comparison.is_held_out ? "held-out" : "training", ElementsText(comparison.policy, names),
      best.baseline.Name(), Percent(reachable));
  if (is_behind) {
    verdict->advice.push_back(
        "more iterations (--iterations) or a larger policy (--hidden_size), because the data teach "
        "more than it has learned");
  } else if (share < kWeakShare) {
    verdict->advice.push_back(
        "data whose observations tell more of what the action depends on, or more of them: no "
        "baseline explains more");
  }
  nlohmann::ordered_json& figures = verdict->figures;
  figures["explained"] = share;
  for (size_t i = 0; i < comparison.policy.explained_elements.size(); ++i) {
    figures["explained_by_element"][names[i]] = comparison.policy.explained_elements[i];
  }
  figures["best_baseline"] = {{"name", best.baseline.Name()}, {"explained", reachable}};
}

}  // namespace

std::vector<std::string> ActionNames(const Dataset& dataset) {
  std::vector<std::string> names;
  if (dataset.action_space.is_discrete()) return names;
  for (int i = 0; i < dataset.action_space.size(); ++i) names.push_back(absl::StrCat(i));
  const auto found = dataset.recipe.find("action_names");
  if (found == dataset.recipe.end()) return names;
  // A recipe that was read from Minari has the list as text.
  const nlohmann::json list = found->is_string()
                                  ? nlohmann::json::parse(found->get<std::string>(), nullptr, false)
                                  : *found;
  if (!list.is_array() || list.size() != names.size()) return names;
  for (size_t i = 0; i < names.size(); ++i) {
    if (list[i].is_string()) names[i] = list[i].get<std::string>();
  }
  return names;
}

std::optional<double> LossFall(const std::vector<std::pair<int, double>>& losses) {
  if (losses.size() < 2) return std::nullopt;
  const auto [last, loss] = losses.back();
  std::optional<double> before;
  for (const auto& [iteration, value] : losses) {
    if (10 * iteration <= 9 * last) before = value;
  }
  if (!before.has_value() || !(*before > 0.0)) return std::nullopt;
  return 1.0 - loss / *before;
}

PolicyVerdict Judge(const std::optional<BaselineComparison>& comparison,
                    const std::vector<std::string>& names, std::optional<double> loss_fall) {
  PolicyVerdict verdict;
  if (comparison.has_value()) {
    verdict.grade = Grade::kGood;
    JudgeFit(*comparison, names, &verdict);
  } else {
    verdict.reason = "the share of the actions that it explains was not measured";
  }
  if (!loss_fall.has_value()) return verdict;
  verdict.figures["loss_fall"] = *loss_fall;
  if (*loss_fall <= kFalling) return verdict;
  verdict.grade = std::min(verdict.grade, Grade::kWeak);
  absl::StrAppendFormat(&verdict.reason,
                        "; undertrained: the validation loss still fell by %s in the last tenth",
                        Percent(*loss_fall));
  verdict.advice.insert(verdict.advice.begin(), "more iterations (--iterations)");
  return verdict;
}

std::string ToText(const PolicyVerdict& verdict) {
  std::string text =
      absl::StrCat("verdict: ", std::string(ToString(verdict.grade)), ": ", verdict.reason, "\n");
  for (const std::string& advice : verdict.advice) absl::StrAppend(&text, "try: ", advice, "\n");
  return text;
}

nlohmann::ordered_json ToJson(const PolicyVerdict& verdict) {
  nlohmann::ordered_json json = {{"grade", std::string(ToString(verdict.grade))}};
  json.update(verdict.figures);
  json["reason"] = verdict.reason;
  json["advice"] = verdict.advice;
  return json;
}

absl::Status CheckGrade(const PolicyVerdict& verdict, Grade least) {
  if (verdict.grade >= least) return absl::OkStatus();
  return absl::FailedPreconditionError(absl::StrCat(
      "--require: expected a verdict of ", std::string(ToString(least)), " or better, received ",
      std::string(ToString(verdict.grade)), ": ", verdict.reason));
}

}  // namespace spikeserve
