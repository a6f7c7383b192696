#include "core/agent/repeated_step.h"

#include <cmath>
#include <limits>
#include <string>

#include "absl/strings/cord.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/agent/agent_session.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

constexpr char kConflictUrl[] = "spikeserve/conflict";

template <typename Expected, typename Received>
absl::Status Conflict(const std::string& field, const Expected& expected, const Received& received,
                      int64_t step) {
  absl::Status status = absl::FailedPreconditionError(
      absl::StrCat(field, ": expected ", expected, " as in the request that was taken for step ",
                   step, ", received ", received, "; another robot may use this session_id"));
  status.SetPayload(kConflictUrl, absl::Cord());
  return status;
}

// Compares the elements of a vector. Every digit that tells two numbers apart is shown.
absl::Status Compare(const char* field, absl::Span<const float> expected,
                     absl::Span<const float> received, int64_t step) {
  if (expected.size() != received.size()) {
    return Conflict(field, absl::StrCat(expected.size(), " numbers"), received.size(), step);
  }
  const auto digits = [](float value) { return absl::StrFormat("%.9g", value); };
  for (size_t i = 0; i < expected.size(); ++i) {
    if (expected[i] == received[i]) continue;
    return Conflict(absl::StrCat(field, "[", i, "]"), digits(expected[i]), digits(received[i]),
                    step);
  }
  return absl::OkStatus();
}

absl::Status CompareActions(const Action& expected, const Action& received, int64_t step) {
  if (expected.discrete != received.discrete) {
    return Conflict("executed_action", absl::StrCat("index ", expected.discrete),
                    absl::StrCat("index ", received.discrete), step);
  }
  return Compare("executed_action", expected.continuous, received.continuous, step);
}

// Both returns-to-go were rounded to float32.
bool IsReward(double reward, double before, double after) {
  constexpr double kRounding = 0.51 * std::numeric_limits<float>::epsilon();
  constexpr double kLeast = std::numeric_limits<float>::denorm_min();
  return std::abs(before - reward - after) <=
         kRounding * (std::abs(before) + std::abs(after)) + kLeast;  // false for NaN
}

}  // namespace

absl::Status CheckRepeatedStep(const Step& step) {
  const Session& session = step.session->session();
  const int64_t number = *step.place.step;
  SPIKESERVE_DCHECK(number < session.step);
  const History& history = session.history;
  const int64_t index = static_cast<int64_t>(history.size()) - (session.step - number);
  if (index < 0) return absl::OkStatus();
  const auto at = static_cast<size_t>(index);
  RETURN_IF_ERROR(Compare("observation", history.observation(at), step.observation, number));
  if (index == 0 || number == 0) return absl::OkStatus();
  const double before = static_cast<double>(history.return_to_go(at - 1));
  const double after = static_cast<double>(history.return_to_go(at));
  if (!IsReward(step.reward, before, after)) {
    return Conflict("reward", absl::StrCat("about ", before - after), step.reward, number);
  }
  if (!step.executed.has_value()) return absl::OkStatus();
  ASSIGN_OR_RETURN(const Action executed,
                   ParseExecutedAction(*step.executed, step.session->policy().action_space));
  return CompareActions(history.action(at - 1), executed, number);
}

bool TakeConflict(absl::Status* status) { return status->ErasePayload(kConflictUrl); }

}  // namespace spikeserve
