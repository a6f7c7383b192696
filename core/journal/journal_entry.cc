#include "core/journal/journal_entry.h"

#include <algorithm>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/action/action_head.h"
#include "core/agent/wiring_check.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/journal/field_codec.h"
#include "core/journal/session_bytes.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

constexpr char kFormat[] = "spikeserve.decision.v1";

// Returns how the first record of a snapshot's format begins.
const std::string& SnapshotPrefix() {
  static const auto* const prefix = [] {
    auto* bytes = new std::string();
    codec::Writer(bytes).Begin(kSessionFormat);
    return bytes;
  }();
  return *prefix;
}

absl::Status Damaged(absl::string_view field, int64_t expected, size_t received) {
  return absl::DataLossError(
      absl::StrCat("journal: ", field, ": expected ", expected, " numbers, received ", received));
}

absl::Status CheckSize(absl::string_view field, int64_t expected, size_t received) {
  return static_cast<size_t>(expected) == received ? absl::OkStatus()
                                                   : Damaged(field, expected, received);
}

absl::Status CheckAction(const Action& action, const ActionSpace& space) {
  if (space.is_discrete() && (action.discrete < 0 || action.discrete >= space.n)) {
    return absl::DataLossError(absl::StrCat("journal: action: expected 0 to ", space.n - 1,
                                            ", received ", action.discrete));
  }
  const int values = space.is_discrete() ? 0 : space.size();
  return CheckSize("action", values, action.continuous.size());
}

absl::Status CheckAnswer(const Answer& answer, const Policy& policy) {
  RETURN_IF_ERROR(CheckAction(answer.action, policy.action_space));
  const int64_t actions = policy.action_space.size();
  RETURN_IF_ERROR(CheckSize("logits", actions, answer.logits.size()));
  const int64_t probabilities = policy.action_space.is_discrete() ? actions : 0;
  return CheckSize("probabilities", probabilities, answer.probabilities.size());
}

// ParseSession() has checked that the arrays of a learner fit each other.
absl::Status CheckLearnerShape(const Learner& learner, const Policy& policy) {
  const auto head = static_cast<int64_t>(policy.weights.head.weight.values.size());
  RETURN_IF_ERROR(CheckSize("learner", head, static_cast<size_t>(learner.head_delta.size())));
  const auto check_factor = [&](size_t size) {
    return size == 0 ? absl::OkStatus()
                     : CheckSize("learner.post", policy.action_space.size(), size);
  };
  RETURN_IF_ERROR(check_factor(static_cast<size_t>(learner.post.size())));
  if (!learner.kept.has_value()) return absl::OkStatus();
  for (const StepFactors& step : learner.kept->steps) {
    RETURN_IF_ERROR(check_factor(step.post.size()));
  }
  return absl::OkStatus();
}

// Checks that a snapshot has the shapes of `policy`.
absl::Status CheckSnapshot(const Session& session, const Policy& policy) {
  const History& history = session.history;
  for (size_t i = 0; i < history.size(); ++i) {
    RETURN_IF_ERROR(
        CheckSize("observation", policy.observation_size(), history.observation(i).size()));
    RETURN_IF_ERROR(CheckAction(history.action(i), policy.action_space));
  }
  if (session.last_answer.has_value()) {
    RETURN_IF_ERROR(CheckAnswer(*session.last_answer, policy));
  }
  if (session.options.head_delta.size() != 0) {
    const auto head = static_cast<int64_t>(policy.weights.head.weight.values.size());
    const auto size = static_cast<size_t>(session.options.head_delta.size());
    RETURN_IF_ERROR(CheckSize("head_delta", head, size));
  }
  if (const auto status = CheckWiringState(policy, session.wiring); !status.ok()) {
    return absl::DataLossError(absl::StrCat("journal: ", status.message()));
  }
  if (session.seat.has_value()) {
    RETURN_IF_ERROR(CheckAction(session.seat->action, policy.action_space));
  }
  return session.learner.has_value() ? CheckLearnerShape(*session.learner, policy)
                                     : absl::OkStatus();
}

// Checks that `entry` is the next decision of `session` and has the shapes of `policy`.
absl::Status CheckEntry(const JournalEntry& entry, const Session& session, const Policy& policy) {
  if (entry.decision != session.decisions || entry.answer.step != session.step) {
    return absl::DataLossError(absl::StrCat("journal: expected decision ", session.decisions,
                                            " at step ", session.step, ", received decision ",
                                            entry.decision, " at step ", entry.answer.step));
  }
  RETURN_IF_ERROR(CheckSize("observation", policy.observation_size(), entry.observation.size()));
  RETURN_IF_ERROR(CheckAnswer(entry.answer, policy));
  if (entry.executed.has_value()) {
    if (session.step == 0) {
      return absl::DataLossError("journal: executed: expected none at step 0, received one");
    }
    RETURN_IF_ERROR(CheckAction(*entry.executed, policy.action_space));
  }
  if (!session.learner.has_value()) return absl::OkStatus();
  const int64_t actions = policy.action_space.size();
  const bool noisy = !policy.action_space.is_discrete() && session.options.action_selection.sample;
  RETURN_IF_ERROR(CheckSize("noise", noisy ? actions : 0, entry.noise.size()));
  const auto head = static_cast<int64_t>(policy.weights.head.weight.values.size());
  return CheckSize("readout", head / actions, entry.readout.size());
}

// Does what AgentSession does with an executed action, which ignores the answered one. An
// operator's correction, which it also learns from, is in a snapshot.
void TakeExecuted(const JournalEntry& entry, const Policy& policy, Session* session) {
  if (!entry.executed.has_value()) return;
  const History& history = session->history;
  if (*entry.executed == history.action(history.size() - 1)) return;
  ReplaceLastAction(policy, *entry.executed, session);
}

void Learn(const JournalEntry& entry, const Policy& policy, Session* session) {
  const ActionChoice choice = {.action = entry.answer.action,
                               .logits = entry.answer.logits,
                               .probabilities = entry.answer.probabilities,
                               .noise = entry.noise};
  session->learner->OnDecision(*session->options.learning, policy, choice, entry.readout,
                               static_cast<double>(entry.answer.return_to_go), entry.reward);
}

}  // namespace

// Lists the members of an entry's binary form, in order, for the writer and the reader.
SPIKESERVE_FIELDS(JournalEntry, decision, reward, observation, executed, answer, readout, noise,
                  suspended)
SPIKESERVE_FIELDS(JournalEntryView, decision, reward, observation, executed, answer, readout, noise,
                  suspended)

std::string SerializeEntry(const JournalEntryView& entry) {
  return codec::Serialize(kFormat, entry);
}

absl::StatusOr<JournalEntry> ParseEntry(const std::string& bytes) {
  return codec::Parse<JournalEntry>(bytes, "entry", kFormat);
}

absl::StatusOr<Journal> ParseJournal(absl::Span<const std::string> records) {
  size_t first = records.size();
  while (first > 0 && !absl::StartsWith(records[first - 1], SnapshotPrefix())) --first;
  if (first == 0) {
    return absl::DataLossError(absl::StrCat("journal: expected a snapshot, received ",
                                            records.size(), " records without one"));
  }
  const auto damaged = [&](size_t i, const absl::Status& status) {
    return absl::DataLossError(
        absl::StrCat("journal: record ", i, " of ", records.size(), ": ", status.message()));
  };
  auto snapshot = ParseSession(records[first - 1]);
  if (!snapshot.ok()) return damaged(first - 1, snapshot.status());
  Journal journal = {.snapshot = *std::move(snapshot), .entries = {}};
  uint64_t next = journal.snapshot.decisions;
  for (size_t i = first; i < records.size(); ++i) {
    auto entry = ParseEntry(records[i]);
    if (!entry.ok()) return damaged(i, entry.status());
    if (entry->decision > next) {
      journal.after_gap = records.size() - i;
      break;
    }
    next = std::max(next, entry->decision + 1);
    journal.entries.push_back(*std::move(entry));
  }
  return journal;
}

// Folds values, and is not AgentSession::Apply(): that computes the answer of a step with the
// engine of this release, which may be another one than the session has acted on, chooses again
// from a fleet's head that has moved on since, and tells observers and listeners what they were
// told when it happened. What both do to the session is in the functions that they share:
// ReplaceLastAction(), Learner::OnDecision(), CheckWiring(), CountDecision().
absl::StatusOr<Session> RestoreSession(Journal journal, const Policy& policy) {
  Session session = std::move(journal.snapshot);
  RETURN_IF_ERROR(CheckSnapshot(session, policy));
  for (JournalEntry& entry : journal.entries) {
    if (entry.decision < session.decisions) continue;
    RETURN_IF_ERROR(CheckEntry(entry, session, policy));
    if (session.learner.has_value()) session.learner->suspended = entry.suspended;
    TakeExecuted(entry, policy, &session);
    if (session.learner.has_value()) Learn(entry, policy, &session);
    if (policy.wiring != nullptr) {
      CheckWiring(policy, session.step, session.history, entry.observation, &session.wiring);
    }
    CountDecision(policy, std::move(entry.answer), entry.observation, entry.reward, &session);
  }
  return session;
}

}  // namespace spikeserve
