#include "core/journal/session_bytes.h"

#include <cstdint>
#include <tuple>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/journal/field_codec.h"

namespace spikeserve {
namespace {

absl::Status Inconsistent(absl::string_view field, absl::string_view expected, int64_t received) {
  return InvalidArgument(absl::StrCat("session.", field), expected, received);
}

absl::Status CheckFactors(absl::string_view field, int64_t size, size_t rewards,
                          const EpisodeFactors& factors) {
  if (factors.rewards.size() != rewards) {
    return Inconsistent(absl::StrCat(field, ".rewards"), absl::StrCat(rewards, " numbers"),
                        static_cast<int64_t>(factors.rewards.size()));
  }
  for (const auto& [post, executed, readout] : factors.steps) {
    const bool is_skipped = post.empty() && executed.empty() && readout.empty();
    const bool fits = static_cast<int64_t>(post.size() * readout.size()) == size &&
                      (executed.empty() || executed.size() == post.size());
    if (is_skipped || fits) continue;
    return Inconsistent(absl::StrCat(field, ".steps"), "factors of the head's shape",
                        static_cast<int64_t>(post.size() * readout.size()));
  }
  return absl::OkStatus();
}

// Checks what waits for verdicts.
absl::Status CheckKept(const LearningOptions& options, const Learner& learner) {
  const int64_t size = learner.head_delta.size();
  if ((learner.kept.has_value() || !learner.waiting.empty()) && options.verdict_seconds <= 0.0) {
    return Inconsistent("learner.waiting", "no factors without verdict_seconds",
                        static_cast<int64_t>(learner.kept_steps()));
  }
  if (learner.kept.has_value()) {
    const size_t steps = learner.kept->steps.size();
    RETURN_IF_ERROR(CheckFactors("learner.kept", size, steps - (steps > 0), *learner.kept));
  }
  if (learner.waiting.size() > Learner::kMostWaiting) {
    return Inconsistent("learner.waiting", absl::StrCat("at most ", Learner::kMostWaiting),
                        static_cast<int64_t>(learner.waiting.size()));
  }
  for (const auto& ended : learner.waiting) {
    if (ended == nullptr || ended->factors.steps.empty()) {
      return absl::InvalidArgumentError(
          "session.learner.waiting: expected episodes with steps, received one without");
    }
    RETURN_IF_ERROR(
        CheckFactors("learner.waiting", size, ended->factors.steps.size(), ended->factors));
  }
  return absl::OkStatus();
}

// Checks that all arrays of the head's shape have one size, and the ranges of the other members.
absl::Status CheckLearner(const LearningOptions& options, const Learner& learner) {
  const int64_t size = learner.head_delta.size();
  const int64_t sums = options.modulator == Modulator::kRealized ? size : 0;
  const int64_t kept = options.scope == Scope::kSession ? size : 0;
  const std::tuple<const char*, int64_t, int64_t> lengths[] = {
      {"learner.trace", learner.trace.size(), size},
      {"learner.trace_sum", learner.trace_sum.size(), sums},
      {"learner.discounted_trace", learner.discounted_trace.size(), sums},
      {"learner.credit", learner.credit.size(), sums},
      {"learner.guard.beginning", learner.guard.beginning.size(), kept},
      {"learner.guard.good", learner.guard.good.size(), kept}};
  for (const auto& [field, length, expected] : lengths) {
    if (length == expected) continue;
    return Inconsistent(field, absl::StrCat(expected, " numbers"), length);
  }
  for (const CorrectionRun& run : learner.runs.runs) {
    if (run.before.size() == kept) continue;
    return Inconsistent("learner.runs.before", absl::StrCat(kept, " numbers"), run.before.size());
  }
  if (learner.runs.runs.size() > CorrectionRuns::kMost) {
    return Inconsistent("learner.runs", absl::StrCat("at most ", CorrectionRuns::kMost),
                        static_cast<int64_t>(learner.runs.runs.size()));
  }
  if (learner.post.size() > 0) {
    if (learner.post.size() * learner.readout.size() != size) {
      return Inconsistent("learner.readout", "one number for each input of the head",
                          learner.readout.size());
    }
    const bool may_be_undone =
        options.modulator == Modulator::kTarget && options.rule != Rule::kCorrections;
    const int64_t before = may_be_undone ? size : 0;
    if (learner.before_update.size() != before) {
      return Inconsistent("learner.before_update", absl::StrCat(before, " numbers"),
                          learner.before_update.size());
    }
  }
  if (learner.guard.returns.size() >= ReturnGuard::kWindow) {
    return Inconsistent("learner.guard.returns", absl::StrCat("fewer than ", ReturnGuard::kWindow),
                        static_cast<int64_t>(learner.guard.returns.size()));
  }
  if (learner.returns.variance < 0.0) {
    return InvalidArgument("session.learner.returns.variance", "at least 0",
                           learner.returns.variance);
  }
  return CheckKept(options, learner);
}

// Checks that a session with a pending contribution is one of a fleet.
absl::Status CheckPending(const Session& session) {
  if (session.pending == nullptr) return absl::OkStatus();
  if (!session.learner.has_value() || session.options.learning->scope != Scope::kFleet) {
    return absl::InvalidArgumentError(
        "session.pending: expected none unless session.options.learning.scope is fleet");
  }
  const int64_t size = session.learner->head_delta.size();
  if (session.pending->delta.size() == size) return absl::OkStatus();
  return Inconsistent("pending.delta", absl::StrCat(size, " numbers"),
                      session.pending->delta.size());
}

// Checks the invariants of a session between two requests.
absl::Status CheckInvariants(const Session& session) {
  if (session.options.version < 1) {
    return Inconsistent("options.version", "at least 1", session.options.version);
  }
  if (session.episode < 0) return Inconsistent("episode", "at least 0", session.episode);
  if (session.step < 0) return Inconsistent("step", "at least 0", session.step);
  const auto timesteps = static_cast<int64_t>(session.history.size());
  if (timesteps > session.step || (timesteps == 0 && session.step > 0)) {
    return Inconsistent("history", absl::StrCat("1 to ", session.step, " timesteps"), timesteps);
  }
  const int64_t last = session.last_answer.has_value() ? session.last_answer->step : -1;
  if (last != session.step - 1) {
    return Inconsistent("last_answer.step", absl::StrCat(session.step - 1), last);
  }
  if ((session.last_end != nullptr) != (session.episode > 0 && session.step == 0)) {
    return absl::InvalidArgumentError(
        "session.last_end: expected one if and only if an episode has ended and the next has not "
        "begun");
  }
  if (session.learner.has_value() != session.options.learning.has_value()) {
    return absl::InvalidArgumentError(
        "session.learner: expected one if and only if session.options.learning is set");
  }
  RETURN_IF_ERROR(CheckPending(session));
  if (session.learner.has_value()) return CheckLearner(*session.options.learning, *session.learner);
  return absl::OkStatus();
}

}  // namespace

std::string SerializeSession(const Session& session) {
  return codec::Serialize(kSessionFormat, session);
}

absl::StatusOr<Session> ParseSession(const std::string& bytes) {
  ASSIGN_OR_RETURN(Session session, codec::Parse<Session>(bytes, "session", kSessionFormat));
  RETURN_IF_ERROR(CheckInvariants(session));
  return session;
}

}  // namespace spikeserve
